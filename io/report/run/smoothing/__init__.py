"""The smoothing section of a run's page. Read ``section`` first."""
