"""Write sound files of every kind that telerig reads, by telerig's simulator and writers."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import tifffile
from high_speed_files import write_cine, write_mraw
from PIL import Image
from scipy.io import savemat, wavfile
from simulated_log import simulated_log

import telerig
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.io.files.csv_table import write_table
from telerig.io.recording.simulated.devices import practice_devices
from telerig.io.simulation.presets import run_preset
from telerig.io.tables.calibration import REJECTED
from telerig.io.tables.run import CORRECTIONS

SIZE_PX = (48, 32)
_SENSOR_ROWS = 60


def write_corpus(folder: Path) -> None:
    """Write a dataset with results, images, videos, cameras and sensor files of other programs."""
    rng = np.random.default_rng(1)
    _dataset(folder / "set", rng)
    _images(folder / "images", rng)
    _run_of_images(folder / "film", rng)
    _foreign(folder / "foreign", rng)
    _recording(folder / "recording", rng)
    _batch(folder / "batch")


def _dataset(folder: Path, rng: np.random.Generator) -> None:
    dataset = telerig.simulate(run_preset("S2", frames=12), rng=rng, out=folder, images=False)
    _extend_rig(folder / "rig.toml")
    dataset = telerig.load_dataset(folder)
    results = folder / "results"
    calibration = telerig.calibrate(dataset, model="radial")
    calibration.save(results / "calibration" / "calibration.json")
    for name, table in (("dots", calibration.dots), ("residuals", calibration.residuals)):
        write_table(table, results / "calibration" / f"{name}.csv")
    comparison = {"verdict": "unchanged", "words": ["same"], "earlier": "before.json", "changes": [
        {"quantity": "left.k1", "unit": "1", "change": 0.1, "sd": 0.2}]}  # fmt: skip
    (results / "calibration" / "comparison.json").write_text(json.dumps(comparison))
    run = telerig.load_run(folder / "runs" / "S2")
    tracks = telerig.track(run, calibration)
    tracks.save(results / "S2")
    telerig.smooth(tracks, calibration, stage=run.stage, model="default").save(results / "S2")
    (results / "S2" / "results.h5").unlink()
    record = {"command": "track", "telerig": "1", "seconds": {"all": 1.0}, "options": {},
              "inputs_sha256": {"runs/S2/frames.csv": "0" * 64}}  # fmt: skip
    (results / "S2" / "run.json").write_text(json.dumps(record))
    rejected = pd.DataFrame(columns=REJECTED.names())
    rejected.loc[0] = ["view00", "left", 10.0, 12.0, 3.0, 2.0, 0.1, "no neighbours"]
    write_table(rejected, results / "calibration" / "rejected.csv")
    corrections = pd.DataFrame(columns=CORRECTIONS.names())
    corrections.loc[0] = ["drop", "0", "", "", "a reflection"]
    write_table(corrections, folder / "runs" / "S2" / "corrections.csv")
    (folder / "runs" / "S2" / "run.toml").write_text("frame_rate_hz = 500.0\nstart_s = 0.0\n")
    _stage_axis(folder, calibration)
    shutil.copytree(results / "S2", folder.parent / "kept")
    for manifest in folder.rglob("manifest.json"):
        manifest.unlink()  # it would refuse every changed file before that is read


def _extend_rig(file: Path) -> None:
    """Give the rig file the tables that the simulator leaves out."""
    text = file.read_text()
    for header, rows in (
        ("[walls.left]", "normal = [0.0, 0.0, 1.0]\nindices = [1.0, 1.5, 1.33]\n"
                         "thickness_mm = 9.0"),
        ("[tracking]", 'cameras = ["left", "right"]'),
        ("[devices.encoder]", 'kind = "encoder"\nport = "/dev/ttyUSB0"\ncounts_per_mm = 100.0'),
        ("[devices.clock]", 'kind = "frames"\nport = "/dev/ttyUSB1"\nprotocol = "regex"\n'
                            "pattern = '(?P<t>\\d+),(?P<frame>\\d+)'"),
    ):  # fmt: skip
        if header not in text:
            text += f"\n{header}\n{rows}\n"
    file.write_text(text)


def _stage_axis(folder: Path, calibration: Calibration) -> None:
    """A target at rest, seen from five positions of the stage along the rig's y axis."""
    place = folder / "stage_axis"
    place.mkdir()
    positions_mm = np.linspace(0, 4, 5)
    pose = next(iter(calibration.target_poses.values()))
    rows = []
    for view, position_mm in enumerate(positions_mm):
        points = pose.apply(calibration.target_points_mm) + [0, position_mm, 0]
        for camera in calibration.cameras:
            pixels = camera.project(points)
            rows += [(view, camera.name, d, *uv) for d, uv in zip(calibration.dot_ids, pixels)]
    dots = pd.DataFrame(rows, columns=["view", "camera", "dot", "u_px", "v_px"])
    dots[["u_px", "v_px"]] += np.random.default_rng(2).normal(0, 0.01, (len(dots), 2))
    write_table(dots, place / "dots.csv")
    moved = pd.DataFrame({"view": range(len(positions_mm)), "position_mm": positions_mm})
    write_table(moved, place / "positions.csv")


def _picture(rng: np.random.Generator, kind: Any = np.uint8) -> Any:
    width, height = SIZE_PX
    return rng.integers(1, np.iinfo(kind).max, (height, width)).astype(kind)


def _images(folder: Path, rng: np.random.Generator) -> None:
    folder.mkdir()
    for name, image, options in (
        ("grey8.tif", _picture(rng), {}),
        ("grey16.tif", _picture(rng, np.uint16), {}),
        ("packed.tif", _picture(rng), {"compression": "zlib"}),
        ("tiles.tif", _picture(rng), {"tile": (16, 16)}),
        ("big.tif", _picture(rng), {"bigtiff": True}),
        ("float.tif", _picture(rng).astype(np.float32), {}),
    ):
        tifffile.imwrite(folder / name, image, **options)
    for name in ("grey.png", "grey.bmp", "grey.jpg"):
        Image.fromarray(_picture(rng)).save(folder / name)
    Image.fromarray(_picture(rng, np.uint16)).save(folder / "grey16.png")


def _run_of_images(folder: Path, rng: np.random.Generator) -> None:
    folder.mkdir()
    pages = np.stack([_picture(rng) for _ in range(4)])
    with tifffile.TiffWriter(folder / "pages.tif") as tiff:
        for page in pages:
            tiff.write(page, contiguous=False, metadata=None)
    tifffile.imwrite(folder / "stack.tif", pages, imagej=True)
    _video(folder / "raw.avi", pages, "rawvideo", "gray")
    _video(folder / "film.mp4", pages, "mpeg4", "yuv420p")
    _video(folder / "wide.mkv", pages, "ffv1", "gray")
    write_cine(folder / "phantom.cine", pages, np.arange(4) / 1000)
    write_mraw(folder / "photron.mraw", pages, bits=8)
    write_mraw(folder / "older.mraw", pages, bits=8, xml=False)


def _video(file: Path, frames: Any, codec: str, pixels: str) -> None:
    import av

    with av.open(str(file), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(100))
        stream.width, stream.height, stream.pix_fmt = *SIZE_PX, pixels
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
        container.mux(stream.encode())


def _foreign(folder: Path, rng: np.random.Generator) -> None:
    import cv2

    folder.mkdir()
    t_s = np.arange(_SENSOR_ROWS) / 1000
    axes = rng.normal(0, 1, (_SENSOR_ROWS, 3))
    rows = [",".join(repr(float(v)) for v in row) for row in np.c_[t_s, axes]]
    (folder / "arm.csv").write_text("logger 7\nt_s,ax_m_s2,ay_m_s2,az_m_s2\n" + "\n".join(rows))
    wavfile.write(folder / "arm.wav", 1000, (axes * 1000).astype(np.int16))
    savemat(folder / "arm.mat", {"t": t_s, "ax": axes[:, 0], "ay": axes[:, 1], "az": axes[:, 2]})
    _tdms(folder / "arm.tdms", axes)
    _matlab_7_3(folder / "arm73.mat", t_s, axes)
    _loggers_texts(folder, axes)
    matrices = {f"M{i}": np.array([[9000.0, 0, 650], [0, 9010, 395], [0, 0, 1]]) for i in (1, 2)}
    turned = cv2.Rodrigues(np.array([0.02, -1.2, 0.03]))[0]
    content = matrices | {"R": turned, "T": np.array([420.0, 5, 280]), "D1": np.zeros(5)}
    for name in ("pair.yml", "pair.xml", "pair.json"):
        storage = cv2.FileStorage(str(folder / name), cv2.FILE_STORAGE_WRITE)
        for key, value in (content | {"image_width": 1280, "image_height": 800}).items():
            storage.write(key, value)
        storage.release()
    _openptv(folder)
    _openlpt(folder)


def _matlab_7_3(file: Path, t_s: Any, axes: Any) -> None:
    with h5py.File(file, "w", userblock_size=512) as hdf5:
        for name, values in (("t", t_s), *zip(("ax", "ay", "az"), axes.T)):
            hdf5[name] = values[None]
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    file.write_bytes(head.ljust(512, b"\0") + file.read_bytes()[512:])


def _loggers_texts(folder: Path, axes: Any) -> None:
    """Stamps with decimal commas; a counter below comments; a line of units; two bytes a letter."""
    cells = [[f"{value:.5f}" for value in row] for row in axes]
    clock = [f"10.03.2024 00:00:{i / 1e3:06.3f}" for i in range(len(axes))]
    rows = [";".join([t, *(c.replace(".", ",") for c in row)]) for t, row in zip(clock, cells)]
    (folder / "stamps.txt").write_text("Logger;7\nZeit;X;Y;Z\n" + "\n".join(rows), "utf-8-sig")
    times = [f"{i};" + ";".join(row) for i, row in enumerate(cells)]
    (folder / "wide.txt").write_text("\n".join(["Logger", "Time;X;Y;Z", *times]), "utf-16")
    rows = [f"{i},{','.join(row)}" for i, row in enumerate(cells)]
    head = "# data_rate = 1 kHz, range 4 g\n;Headers,count,Ax,Ay,Az\n"
    (folder / "counter.txt").write_text(head + "\n".join(rows) + "\n;switched off\n")
    rows = [f"{i}\t" + "\t".join(row) + "\t" for i, row in enumerate(cells)]
    head = "time\tX\tY\tZ\t\nms\tm/(s^2)\tm/(s^2)\tm/(s^2)\t\n"
    (folder / "units.txt").write_text(head + "\n".join(rows))


def _tdms(file: Path, axes: Any) -> None:
    try:
        from nptdms import ChannelObject, TdmsWriter
    except ImportError:
        return
    facts = {"unit_string": "g", "wf_increment": 0.001}
    with TdmsWriter(file) as writer:
        writer.write_segment(
            [
                ChannelObject("arm", name, axes[:, i], facts)
                for i, name in enumerate(("x", "y", "z"))
            ]
        )


def _openptv(folder: Path) -> None:
    (folder / "cam.ori").write_text(
        "2.0 1.0 480.0\n0.004 -0.006 0.02\n\n1 0 0\n0 1 0\n0 0 1\n\n0.0 0.0\n60.0\n\n0.0 0.0 10.0\n"
    )
    (folder / "cam.addpar").write_text("0 0 0 0 0 1 0\n")
    (folder / "ptv.par").write_text(
        "1\nimg/cam\ncal/cam.tif\n1\n0\n1\n1280\n1024\n0.012\n0.0125\n0\n1\n1\n1\n1\n"
    )


def _openlpt(folder: Path) -> None:
    unit = "1.0,0.0,0.0\n0.0,1.0,0.0\n0.0,0.0,1.0"
    parts = ["PINHOLE", "None", "None", "800,1280", "20000.0,0,640\n0,20000.0,400\n0,0,1",
             "0,0,0,0,0", "0,0,0", unit, unit, "0.0,0.0,500.0", "0.0,0.0,-500.0"]  # fmt: skip
    (folder / "cam1.txt").write_text("".join(f"# part\n{part}\n" for part in parts))


def _recording(folder: Path, rng: np.random.Generator) -> None:
    folder.mkdir()
    sims = [
        replace(sim, device=replace(sim.device, port=f"/dev/ttyUSB{i}"))
        for i, sim in enumerate(practice_devices())
    ]
    simulated_log(folder / "recording.raw", sims, 0.2, rng)


def _batch(folder: Path) -> None:
    folder.mkdir()
    jobs = [
        {"kind": kind, "dataset": "/data/tank", "run": run, "status": "done", "words": "",
         "figures": {"verdict": "GOOD", "views": 12, "rms_px": 0.01}, "seconds": 3.0, "host": "a"}
        for kind, run in (("calibrate", ""), ("track", "rise"), ("smooth", "rise"))
    ]  # fmt: skip
    (folder / "batch.json").write_text(json.dumps({"jobs": jobs}))
    bubbles = pd.read_csv(folder.parent / "set" / "results" / "S2" / "bubble_summary.csv")
    bubbles.insert(0, "run", "rise")
    bubbles.insert(0, "dataset", "/data/tank")
    write_table(bubbles, folder / "bubbles.csv")
