"""One description of every results file: written by the estimator, read by everybody else.

In: what a stage of the estimator found, or a results folder. Out: checked records and tables. Read
``record`` (JSON), then ``calibration``, ``tracking``, ``smoothing`` for the files of each stage.
"""
