"""The command line, one module a command; a module has the name of its command.

Read `main` first: it lists the commands by the steps of the work. `import_files` is `telerig
import`. Four more modules are no commands: `start` is the entry point of the installed program,
`console` has messages, progress and exit codes, `options` the options that several commands share,
and `batch_job` is the process of one job of a batch.
"""

import os

# before NumPy is loaded: matrices here are small, and threads of the algebra library wait for
# each other and for the processes beside them (calibrating 24 small images: 1.4 of 10 s of CPU)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
