"""Keep the imported recordings of a run: `accelerometer.csv` has the readings of every sensor."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import pandas as pd

from telerig.errors import InputError, suggestion
from telerig.io.dataset.tables import read_accelerometer_csv
from telerig.io.files.csv_table import write_table


def merge_accelerations(table: pd.DataFrame, path: str | PathLike[str]) -> list[str]:
    """Write ``table`` to `accelerometer.csv`, and keep the readings of other sensors in that file.

    Returns the names of the sensors whose earlier readings were replaced.
    """
    file = Path(path)
    replaced: list[str] = []
    if file.is_file():
        old = read_accelerometer_csv(file, None)
        new = set(table["sensor"])
        replaced = sorted(set(old["sensor"]) & new)
        table = pd.concat([old[~old["sensor"].isin(new)], table], ignore_index=True)
    write_table(table, file)
    return replaced


def imported_records(path: str | PathLike[str]) -> dict[str, pd.DataFrame]:
    """Return the readings of each sensor in `accelerometer.csv`, {} where there is no file."""
    file = Path(path)
    if not file.is_file():
        return {}
    table = read_accelerometer_csv(file, None)
    return {str(name): one for name, one in table.groupby("sensor", sort=False)}


def remove_accelerations(sensor: str, path: str | PathLike[str]) -> int:
    """Remove the readings of a sensor from `accelerometer.csv`, and the file if none are left.

    Returns their number. Raises InputError when the file has none of this sensor.
    """
    records = imported_records(path)
    if sensor not in records:
        raise InputError(
            f"has no readings of {sensor!r}",
            where=str(path),
            todo=suggestion(sensor, list(records)) if records else "nothing is to be removed",
        )
    removed = len(records.pop(sensor))
    if records:
        write_table(pd.concat(list(records.values()), ignore_index=True), path)
    else:
        Path(path).unlink()
    return removed
