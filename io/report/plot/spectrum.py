"""Power spectral densities of the bubbles' velocities and of the shake."""

from __future__ import annotations

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.spectra import LEAST_FRAMES, Spectrum, segment, welch_density

_MOST_TRACKS = 20
_FINITE_SHARE = 0.7


def velocity_spectrum(trajectories: pd.DataFrame, kind: str = "") -> Spectrum:
    """Return the mean density of the velocity of the longest tracks, in (mm/s)²/Hz.

    kind : "", "naive_" or "rts_". Raises InputError when no track is long enough.
    """
    names = [f"{kind}v{axis}_mm_s" for axis in "xyz"]
    tracks = sorted((mine for _, mine in trajectories.groupby("particle")), key=len, reverse=True)[
        :_MOST_TRACKS
    ]
    found: list[Array] = []
    weights, frequencies = [], np.zeros(0)
    length = segment(len(tracks[0])) if tracks else 0
    for track in tracks if length and set(names) <= set(trajectories) else []:
        values = track[names].to_numpy(float)
        if len(track) < max(length, LEAST_FRAMES):
            break
        if np.isfinite(values).all(1).mean() >= _FINITE_SHARE:
            frequency, density = welch_density(track["t_s"].to_numpy(float), values, length)
            if not found or density.shape == found[0].shape:
                frequencies = frequency
                found.append(density)
                weights.append(len(track))
    if not found:
        what = f"no track has {LEAST_FRAMES} frames with a velocity"
        raise InputError(what, where="telerig.plot.spectra", todo="give a longer run")
    return Spectrum(frequencies, np.asarray(np.average(found, axis=0, weights=weights)))


def shake_spectrum(shake: pd.DataFrame, camera: str) -> Spectrum | None:
    """Return the density of a camera's shake in shake.csv, in µm²/Hz; None for a short run."""
    if len(shake) < LEAST_FRAMES:
        return None
    values = 1e3 * shake[[f"{camera}_{axis}_mm" for axis in "xyz"]].to_numpy(float)
    return Spectrum(*welch_density(shake["t_s"].to_numpy(float), values, segment(len(values))))
