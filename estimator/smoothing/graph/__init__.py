"""The factor graph of a smoothing problem and its solution.

In: a ``SmoothingProblem`` with priors. Out: states, covariances, evidence. Read ``solve``,
``layout`` and ``linear``.
"""
