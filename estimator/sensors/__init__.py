"""This folder checks the records of the encoder and the accelerometers.

In: the sensor tables of a run. Out: warnings, and errors for records that cannot be used. Read
``checks`` first.
"""
