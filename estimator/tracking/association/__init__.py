"""Which measurement continues which track.

In: predicted tracks and one frame's measurements. Out: updated tracks, and open hypotheses. Read
``likelihoods``, then ``hypotheses``.
"""
