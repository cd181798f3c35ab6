"""The page of a batch.

In: batch.json. Out: report.html with links to the other reports. Read ``report``.
"""
