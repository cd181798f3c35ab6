"""Raw logs of simulated devices, made at once instead of in real time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.random import Generator

from telerig.io.recording.log import END, RECEIVED, Entry, LogHeader, RawLog
from telerig.io.recording.simulated.devices import SimulatedDevice, Truth, made_since_last
from telerig.io.rig_file.description import DeviceDescription


def simulated_log(
    path: Path,
    sims: Sequence[SimulatedDevice],
    seconds: float,
    rng: Generator,
    described: Sequence[DeviceDescription] | None = None,
) -> list[Truth]:
    """The raw log that streaming devices would give, made at once; least delay is near 0.

    described : what the log's header states about the devices; None states what they are.
    """
    header = LogHeader(0, "simulated", (), tuple(described or (sim.device for sim in sims)))
    truths, entries = [], []
    for index, sim in enumerate(sims):
        truth = Truth()
        truths.append(truth)
        count = int(2.5 * seconds / sim.jitter_s) + 1
        for flush_s in np.cumsum(rng.uniform(0, sim.jitter_s, count)):
            if flush_s > seconds:
                break
            _, _, data = made_since_last(sim, truth, float(flush_s), rng)
            if data:
                entries.append(Entry(RECEIVED, index, int(flush_s * 1e9), data))
    with RawLog(path, header) as log:
        for entry in sorted(entries, key=lambda e: e.time_ns):
            log.append(entry)
        log.append(Entry(END, 0, int(seconds * 1e9), b""))
        log.flush()
    return truths
