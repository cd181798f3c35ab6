"""The page of a run, tracked and perhaps smoothed, from its results folder alone. Read
``report`` first."""
