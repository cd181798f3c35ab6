"""One thread for linear algebra in each of xdist's workers, which are one per core already.

To be imported before NumPy: later it is too late. Tests of small matrices take half the time so.
"""

import os

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
