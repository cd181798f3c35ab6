"""This folder calibrates, tracks and smooths many datasets, one job at a time or several at once.

In: the folders of datasets. Out: their results folders, and the records of the batch. Read
``jobs``, then ``batch``.
"""
