"""The tracking section of a run's page. Read ``results`` and ``tables`` first."""
