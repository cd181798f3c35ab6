"""Can this run separate the bubbles' motion from the rig's shake?

In: a solved smoothing graph. Out: verdict, modes, tests of residuals. Read ``judge``, then
``identifiability``.
"""
