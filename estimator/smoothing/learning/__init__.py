"""Hyper-parameters of shake and bubbles, learned by maximum marginal likelihood.

In: a ``SmoothingProblem``. Out: its priors. Read ``learn``, then ``lines_of_sight`` and
``evidence``.
"""
