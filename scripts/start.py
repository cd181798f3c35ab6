"""Start the command `telerig`; Ctrl-C ends it at any moment without a traceback.

This module loads nothing at first, because an interrupt while libraries are loaded must be quiet,
too.
"""

from __future__ import annotations

import signal


def run() -> None:
    """Run the command; the entry point of the installed program."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from telerig.scripts.console import interruptible
    from telerig.scripts.main import run as run_command

    try:
        with interruptible():
            run_command()
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
