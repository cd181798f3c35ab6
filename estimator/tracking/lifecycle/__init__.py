"""Birth and death of tracks, splits and mergers.

In: what no track explains, and tracks that nothing continues. Out: new and ended tracks. Read
``birth`` first.
"""
