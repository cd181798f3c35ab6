"""Sensors on serial lines: recorded as raw bytes, then turned into the tables of a run.

In: the devices of rig.toml. Out: recording.raw, stage.csv, accelerometer.csv, frames.csv and
recording.json. Read ``session`` (recording) first, then ``tables`` and ``replay``.
"""
