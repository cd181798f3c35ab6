"""Whether the sensors of a run agree with its images, and on which clock they are.

In: a `SmoothingProblem` with complete sensor records. Out: the problem with each record on the
clock of the frames, and findings. Read ``aligned.py`` first; the regressions are in
`telerig.estimator.sensors`.
"""
