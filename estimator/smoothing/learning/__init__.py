"""Learns the hyper-parameters of shake and bubbles by maximum marginal likelihood.

In: a ``SmoothingProblem``. Out: a ``ShakeModel``, its priors. Read ``learn`` first, then
``lines_of_sight`` and ``evidence``.
"""
