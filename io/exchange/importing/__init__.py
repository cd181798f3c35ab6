"""Cameras and recordings of other programs, as cameras and tables of this library.

In: files of OpenLPT, OpenCV, OpenPTV and of data loggers. Out: cameras, or a table of readings.
Read ``pinhole`` first, which converts every imported camera.
"""
