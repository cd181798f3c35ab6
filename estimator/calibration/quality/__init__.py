"""How good is a calibration? Checks, residual tests, split halves, comparison, uncertainty map.

In: a problem, a fit or a ``Calibration``. Out: numbers and notes for the report. Read ``checks``
first.
"""
