"""Many datasets and runs: calibrated, tracked and smoothed, one job at a time or many at once."""
