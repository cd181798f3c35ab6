"""Which detections of all cameras are the same bubble.

In: the detections of one frame in two to four cameras, and predicted tracks. Out: groups with
probabilities. Read ``groups`` first, then ``evidence`` (predicted tracks) and ``model`` (what the
views of a bubble have in common), which ``learning`` estimates from a run.
"""
