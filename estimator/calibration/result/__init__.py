"""The product of a calibration, as the stages after it take it.

In: numbers of a fit, or files. Out: a ``Calibration``. Read ``calibration`` first.
"""
