"""`telerig doctor` finds problems of the installation, the serial ports or a dataset.

In: this computer, or the folder of a dataset. Out: one ``Check`` per question, all in ``checks``.
"""
