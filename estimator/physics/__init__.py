"""What a bubble scientist takes home: sizes, forces, oscillations, and the swarm.

In: trajectories in the laboratory frame, outlines, and the liquid's properties. Out: bubbles.csv,
bubble_summary.csv and the swarm's numbers. Read ``frames`` first.
"""
