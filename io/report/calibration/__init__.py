"""The page of a calibration, from its results folder alone. Read ``report`` first."""
