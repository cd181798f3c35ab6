"""Which bubble of the second camera is which of the first.

In: the detections of one frame in both cameras, and predicted tracks. Out: pairs with
probabilities. Read ``matching`` first; ``learning`` estimates from a run what both views of a
bubble have in common.
"""
