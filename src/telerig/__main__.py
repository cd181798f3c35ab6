"""Run the command line as `python -m telerig`."""

from telerig.scripts.start import run

run()
