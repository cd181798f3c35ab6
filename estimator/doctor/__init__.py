"""`telerig doctor`: what is wrong with the installation, the serial ports or a dataset.

In: this machine, or a dataset's folder. Out: one ``Check`` per question, all in ``checks``.
"""
