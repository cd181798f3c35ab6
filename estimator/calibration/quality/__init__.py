"""How good is a calibration? Checks, tests of residuals, split halves, comparisons, maps.

In: a problem, a fit or a ``Calibration``. Out: numbers and warnings for the report. Read
``checks`` first.
"""
