"""A simulated run before it is written: bubbles, stage, shake, sensors.

In: a preset. Out: the scene in time and what each camera sees. Read ``presets``, then ``scene``.
"""
