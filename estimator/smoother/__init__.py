"""The smoothing graph: bubbles, carriage and camera offsets from all that was measured."""
