"""Reports, films and overlays, made from nothing but a results folder.

In: the files of a calibration, a run or a batch. Out: report.html, films, pictures. Read ``remake``
first: it calls `calibration.report`, `run.report` or `batch.report`.
"""
