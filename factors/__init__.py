"""This folder contains residuals with analytic Jacobians, stochastic motion processes, and thin
wrappers for GTSAM.

A residual is a pure NumPy function. Read ``projection`` for the calibration, ``state_space`` for
the smoothing.
"""
