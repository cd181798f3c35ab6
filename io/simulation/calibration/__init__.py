"""The true rig and target of a simulated calibration.

In: a ``SimulationConfig``. Out: true cameras, dots, poses. Read ``scene``.
"""
