"""Residuals with analytic Jacobians and their thin GTSAM wrappers."""
