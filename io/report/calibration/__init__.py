"""The page of a calibration: tables, figures, target shape, one dot, rig and next view.

In: calibration.json, residuals.csv and what lies beside them. Out: report.html. Read ``report``.
"""
