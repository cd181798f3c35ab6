"""telerig doctor: what is wrong with the installation, the ports or a dataset, and what to do."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from telerig.scripts.console import EXIT_REJECTED, errors_in_words, run_file, say

_SIGNS = {"ok": "ok", "note": "note", "warning": "WARNING", "failure": "FAILURE"}
_WIDTH = 8


@errors_in_words()
def doctor(
    dataset: Annotated[Path | None, typer.Argument(help="Dataset or run to check as well.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for other programs.")] = False,
) -> None:
    """Check the installation, the serial ports, and a dataset or a run if one is given.

    Of each run it also estimates how long tracking and smoothing will take.

    Exit code 0: nothing prevents the work, though there may be warnings. 1: there is a failure.
    """
    from telerig.estimator.doctor.checks import check_installation, check_ports

    checks = [*check_installation(), *check_ports()]
    if dataset is not None:
        from telerig.estimator.doctor.checks import check_dataset

        checks += check_dataset(dataset)
    if as_json:
        say(json.dumps([asdict(check) for check in checks], indent=1, ensure_ascii=False))
    else:
        width = max(len(check.what) for check in checks)
        for check in checks:
            say(f"{_SIGNS[check.status]:<{_WIDTH}}{check.what:<{width}}  {check.words}")
            if check.todo:
                say(f"{'':{_WIDTH + width + 2}}-> {check.todo}")
    if any(check.status == "failure" for check in checks):
        raise typer.Exit(EXIT_REJECTED)


if __name__ == "__main__":
    run_file(doctor)
