"""Which detections of all cameras are the same bubble.

In: the detections of one frame in two to four cameras, and predicted tracks. Out: groups with
probabilities. Read ``matching`` (pairs) first, then ``groups`` and ``evidence`` (predicted tracks);
``learning`` estimates from a run what the views of a bubble have in common.
"""
