"""This folder contains pure geometry: cameras, lens models, poses, the target, windows and
triangulation.

Nothing here reads an image or a file or knows a solver. Read ``camera`` first.
"""
