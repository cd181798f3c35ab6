"""Films of a run: the path in space, and both camera views. Read ``film`` and ``views`` first."""
