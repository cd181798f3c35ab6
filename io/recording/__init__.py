"""Sensors on serial lines: read, kept as raw bytes, turned into the tables of a run."""
