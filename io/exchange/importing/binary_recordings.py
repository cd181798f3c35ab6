"""Read recordings of accelerometers from WAV, MAT and TDMS files."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError, need_package
from telerig.io.exchange.importing.recording import EXPORT_AGAIN, Recording
from telerig.io.machine.parallel import isolated


@contextmanager
def _reading(path: Path, kind: str) -> Iterator[list[warnings.WarningMessage]]:
    """Turn errors of a library that reads a damaged file into InputError; yield its warnings."""
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            yield warned
    except InputError:
        raise
    except Exception as error:
        what = f"is no {kind} file that can be read ({error or type(error).__name__})"
        raise InputError(what, where=str(path), todo=EXPORT_AGAIN) from error


def read_wav(path: Path) -> Recording:
    """Read channels and rate of a WAV file; whole numbers are scaled so that ±1 is full scale."""
    from scipy.io import wavfile

    with _reading(path, "WAV") as warned:
        rate, samples = wavfile.read(path)
    if any("EOF" in str(one.message) for one in warned):
        raise InputError("ends too early", where=str(path), todo=EXPORT_AGAIN)
    if not samples.size:
        raise InputError("holds no samples", where=str(path), todo=EXPORT_AGAIN)
    values = samples.reshape(len(samples), -1).astype(float)
    if samples.dtype == np.uint8:
        values = (values - 128) / 128
    elif samples.dtype.kind == "i":
        values /= -float(np.iinfo(samples.dtype).min)
    channels = {str(i): column for i, column in enumerate(values.T)}
    return Recording(str(path), channels, rate_hz=float(rate))


def read_mat(path: Path) -> Recording:
    """Read vectors by name (``struct.field``); columns of matrices are name_0, name_1, ..."""
    with _reading(path, "MAT"):
        try:
            content = isolated(partial(loaded_mat, path))
        except NotImplementedError:
            content = isolated(partial(loaded_hdf5, path))
    channels: dict[str, NDArray[Any]] = {}
    for name, array in content.items():
        if array.ndim == 1:
            channels[name] = array
        elif array.ndim == 2:
            columns = array if array.shape[0] >= array.shape[1] else array.T
            channels |= {f"{name}_{i}": column for i, column in enumerate(columns.T)}
    return Recording(str(path), channels)


def loaded_mat(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of numbers in a MAT file up to version 7, without axes of length 1."""
    from scipy.io import loadmat

    found: dict[str, NDArray[Any]] = {}

    def add(name: str, value: Any) -> None:
        array = np.asarray(value)
        if array.dtype.names and array.size == 1:
            for key in array.dtype.names:
                add(f"{name}.{key}", array[key].item())
        elif array.dtype.kind in "iuf":
            found[name] = array

    for name, value in loadmat(path, squeeze_me=True).items():
        if not name.startswith("__"):
            add(name, value)
    return found


def loaded_hdf5(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of numbers in a MAT file of version 7.3, without axes of length 1."""
    import h5py

    found: dict[str, NDArray[Any]] = {}

    def add(name: str, item: Any) -> None:
        text = item.attrs.get("MATLAB_class", b"") in (b"char", "char")
        hidden = name.startswith("#") or "MATLAB_empty" in item.attrs
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "iuf" and not (text or hidden):
            found[name.replace("/", ".")] = np.squeeze(item[()].T)

    with h5py.File(path) as file:
        file.visititems(add)
    return found


def read_tdms(path: Path, group: str | None = None) -> Recording:
    """Read the channels of one group, with their units and rate."""
    nptdms = need_package("nptdms", "tdms", "reading a TDMS file")
    nptdms.log.log_manager.set_level(logging.CRITICAL)  # what it finds is in our errors
    with _reading(path, "TDMS"):
        return _of_tdms(nptdms.TdmsFile.read(path), path, group)


def _of_tdms(file: Any, path: Path, group: str | None) -> Recording:
    groups = [g for g in file.groups() if g.channels()]
    chosen = [g for g in groups if group in (None, g.name)]
    if not groups:
        raise InputError("holds no channels", where=str(path), todo=EXPORT_AGAIN)
    if len(chosen) != 1:
        names = ", ".join(g.name for g in groups)
        raise InputError(
            f"has no group {group!r}" if group else f"has {len(groups)} groups",
            where=str(path),
            todo=f"name one with --group: {names}",
        )
    found = chosen[0].channels()
    units = {c.name: str(c.properties["unit_string"]) for c in found
             if c.properties.get("unit_string")}  # fmt: skip
    steps = {float(c.properties["wf_increment"]) for c in found if "wf_increment" in c.properties}
    starts = {float(c.properties.get("wf_start_offset", 0.0)) for c in found}
    if len(steps) > 1 or len(starts) > 1:
        raise InputError(
            "its channels were sampled at different times",
            where=str(path),
            todo="resample them to one clock before the import",
        )
    step = steps.pop() if steps else 0.0
    channels = {c.name: np.asarray(c[:]) for c in found}
    return Recording(str(path), channels, units, 1 / step if step > 0 else None, starts.pop())
