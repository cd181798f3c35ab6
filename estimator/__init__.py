"""The back end: initialisation, self-calibration, covariance, diagnostics."""
