"""A simulated run before it is written: bubbles, stage, shake, sensors.

In: a ``RunConfig``. Out: the scene in time and what each camera sees. Read ``scene``.
"""
