"""One job of a batch in a process of its own: `python -m telerig.scripts.batch_job`.

Reads the job, a line of JSON, from standard input and answers with a line of JSON. The standard
input stays open as long as somebody wants the answer.
"""

from __future__ import annotations

import _thread
import json
import os
import signal
import sys
import threading
import time

from telerig.errors import TelerigError
from telerig.estimator.batch.batch import FAILED, do_job, failure
from telerig.estimator.batch.jobs import Job
from telerig.io.files.atomic import plain

_END_WITHIN_S = 10.0


def main() -> None:
    """Do the job that is asked for. What other code prints goes to standard error.

    A batch that a shell runs in the background ignores Ctrl-C, and so would this process, which
    inherits that; `stop_all` needs it to react, so the handler is set again.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    answer = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    job = Job.from_json(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        result = do_job(job)
    except TelerigError as error:
        result = failure(FAILED, str(error))
    answer.write(json.dumps(plain(result)) + "\n")
    answer.flush()


def _end_with_parent() -> None:
    """End when the asking process has ended: as after Ctrl-C, or at once if that takes too long."""
    os.read(0, 1)
    _thread.interrupt_main()
    time.sleep(_END_WITHIN_S)
    os._exit(130)


if __name__ == "__main__":
    main()
