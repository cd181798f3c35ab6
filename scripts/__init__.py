"""The command line, one module a command."""

import os

# before NumPy is loaded: matrices here are small, and threads of the algebra library wait for
# each other and for the processes beside them (calibrating 24 small images: 1.4 of 10 s of CPU)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
