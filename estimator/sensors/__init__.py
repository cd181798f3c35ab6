"""Checks of the encoder's and the accelerometers' records.

In: the sensor tables of a run. Out: warnings, and errors for records that cannot be used. Read
``checks`` first.
"""
