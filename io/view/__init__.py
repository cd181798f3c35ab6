"""`telerig view`: results on one time line in the viewer of rerun (https://rerun.io).

In: a results folder, and the images of its dataset where they are there. Out: a rerun recording, in
a window, in a browser or in a file. Read ``show`` first.
"""
