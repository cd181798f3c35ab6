"""Closed-form starts of a self-calibration, and the ambiguities that a start must resolve.

In: a ``Problem``. Out: a state near the solution. Read ``known_target``, then
``mirror_ambiguity``.
"""
