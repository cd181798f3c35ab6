"""Runs: every kind of recording gives its frames back; what does not fit together is refused."""

from __future__ import annotations

import builtins
import gc
import pickle
import struct
import tracemalloc
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.io.dataset import load_dataset
from telerig.io.frames import PageFrames
from telerig.io.run import RunData, load_run

RNG = np.random.default_rng(3)
WIDTH, HEIGHT = 48, 32
SIZES = {"left": (WIDTH, HEIGHT), "right": (WIDTH, HEIGHT)}
CAMERAS = ("left", "right")

RIG = """schema = 1
[cameras.left]
image_size_px = [48, 32]
scale_px_per_mm = 10.0
[cameras.right]
image_size_px = [48, 32]
scale_px_per_mm = 10.0
[target]
layout = "grid"
rows = 3
columns = 5
pitch_mm = 7.0
dot_diameter_mm = 2.4
marks = [[1, 2], [1, 3], [0, 2]]
mark_diameter_mm = 3.6
[accelerometers.arm_left]
mounted_on = "left"
axes = [[1,0,0],[0,1,0],[0,0,1]]
noise_density_ug_sqrt_hz = 22.5
"""


def movie(count: int, bits: int = 8, seed: int = 0) -> NDArray[Any]:
    """(count, HEIGHT, WIDTH) frames that differ all over."""
    kind = np.uint8 if bits == 8 else np.uint16
    return np.random.default_rng(seed).integers(1, 1 << bits, (count, HEIGHT, WIDTH)).astype(kind)


LEFT, RIGHT = movie(6, seed=1), movie(6, seed=2)


def write_images(
    folder: Path, frames: NDArray[Any], names: Sequence[int] | None = None, suffix: str = ".tif"
) -> None:
    import imageio.v3 as iio

    folder.mkdir(parents=True)
    for number, frame in zip(names or range(len(frames)), frames):
        file = folder / f"{number:06d}{suffix}"
        tifffile.imwrite(file, frame) if suffix == ".tif" else iio.imwrite(file, frame)


def write_video(file: Path, frames: NDArray[Any], codec: str, pixels: str, **options: str) -> None:
    av = pytest.importorskip("av")
    given = "gray" if frames.dtype == np.uint8 else pixels
    with av.open(str(file), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(100), options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pixels
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format=given)))
        container.mux(stream.encode())


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """An empty run of a dataset, at 100 frames a second."""
    (tmp_path / "rig.toml").write_text(RIG)
    folder = tmp_path / "runs" / "rise"
    folder.mkdir(parents=True)
    (folder / "run.toml").write_text("frame_rate_hz = 100.0\nstart_s = 2.0\n")
    return folder


@pytest.fixture
def full_run(run_folder: Path) -> Path:
    write_images(run_folder / "left", LEFT)
    write_images(run_folder / "right", RIGHT)
    return run_folder


def error_of(path: Path, *words: str, **options: Any) -> str:
    """The message of the error that loading raises, which has what to do and all the words."""
    with pytest.raises(InputError) as caught:
        load_run(path, **options)
    return checked(str(caught.value), *words)


def checked(message: str, *words: str) -> str:
    assert "\n  -> " in message, "says what to do"
    for word in words:
        assert word in message, message
    return message


def assert_frames(run: RunData, camera: str, frames: NDArray[Any]) -> None:
    got = list(run.frames_of(camera))
    assert len(got) == len(frames)
    for image, expected in zip(got, frames):
        assert image is not None and image.dtype == expected.dtype
        np.testing.assert_array_equal(image, expected)


# --- the kinds of recordings -------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".tif", ".png", ".bmp"])
def test_image_sequences(suffix: str, run_folder: Path) -> None:
    write_images(run_folder / "left", LEFT, suffix=suffix)
    write_images(run_folder / "right", RIGHT, suffix=suffix)
    run = load_run(run_folder)
    assert (run.name, run.cameras, run.frame_count) == ("rise", CAMERAS, 6)
    assert run.source == "images" and run.notes == []
    assert run.rig is not None and run.rig.first == "left"
    np.testing.assert_allclose(run.t_s, 2.0 + np.arange(6) / 100, rtol=1e-15)
    assert run.position_mm is None and run.stage is None and run.detections is None
    assert_frames(run, "left", LEFT)
    assert_frames(run, "right", RIGHT)
    np.testing.assert_array_equal(run.image(1, 4), RIGHT[4])


def test_names_without_leading_zeros_come_in_the_order_of_their_numbers(run_folder: Path) -> None:
    for camera in CAMERAS:
        (run_folder / camera).mkdir()
        for k, frame in enumerate(movie(12)):
            tifffile.imwrite(run_folder / camera / f"shot{k + 1}.tif", frame)
    assert_frames(load_run(run_folder), "right", movie(12))


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("kind", ["series", "pages", "big", "imagej", "compressed", "motorola"])
def test_multi_page_tiff(kind: str, bits: int, run_folder: Path) -> None:
    frames = movie(7, bits)
    for camera in CAMERAS:
        file = run_folder / f"{camera}.tif"
        if kind == "pages":
            with tifffile.TiffWriter(file) as writer:
                for frame in frames:
                    writer.write(frame, contiguous=False, metadata=None)
        else:
            options: dict[str, Any] = {
                "series": {},
                "big": {"bigtiff": True},
                "imagej": {"imagej": True},
                "compressed": {"compression": "zlib"},
                "motorola": {"byteorder": ">"},
            }[kind]
            tifffile.imwrite(file, frames, photometric="minisblack", **options)
    run = load_run(run_folder)
    assert_frames(run, "left", frames)
    np.testing.assert_array_equal(run.image("right", 5), frames[5])


VIDEOS = [
    ("avi", "rawvideo", "gray", 8),
    ("avi", "rawvideo", "bgr24", 8),
    ("avi", "ffv1", "gray", 8),
    ("mkv", "ffv1", "gray16le", 16),
    ("avi", "ffv1", "gray12le", 12),
]


@pytest.mark.parametrize(("suffix", "codec", "pixels", "bits"), VIDEOS)
def test_lossless_videos_in_any_order(
    suffix: str, codec: str, pixels: str, bits: int, run_folder: Path
) -> None:
    frames = movie(40, bits)
    for camera in CAMERAS:
        write_video(run_folder / f"{camera}.{suffix}", frames, codec, pixels)
    run = load_run(run_folder)
    assert run.frame_count == 40
    for k in [*RNG.permutation(40), 3, 4, 5, 4, 39, 0]:
        np.testing.assert_array_equal(run.image("left", int(k)), frames[k])


def test_mp4_with_frames_that_depend_on_later_ones(run_folder: Path) -> None:
    """x264 with B-frames: packets are not in the order of time; levels tell the frames apart."""
    frames = np.repeat(np.arange(20, 220, 4, dtype=np.uint8), HEIGHT * WIDTH)
    frames = frames.reshape(-1, HEIGHT, WIDTH)
    for camera in CAMERAS:
        file = run_folder / f"{camera}.mp4"
        write_video(file, frames, "libx264", "gray", bf="3", g="12", crf="4")
    run = load_run(run_folder)
    assert run.frame_count == len(frames)
    for k in [*range(len(frames)), *RNG.permutation(len(frames))]:
        image = run.image("left", int(k))
        assert image is not None and abs(float(image.mean()) - 20 - 4 * k) < 1.5, k


def test_a_run_with_a_video_goes_to_another_process(run_folder: Path) -> None:
    for camera in CAMERAS:
        write_video(run_folder / f"{camera}.avi", LEFT, "ffv1", "gray")
    run = load_run(run_folder)
    run.image("left", 2)
    again = pickle.loads(pickle.dumps(run))
    assert_frames(again, "left", LEFT)


def test_video_without_pyav_names_the_command(
    run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for camera in CAMERAS:
        write_video(run_folder / f"{camera}.avi", LEFT, "ffv1", "gray")
    real: Callable[..., Any] = builtins.__import__

    def without_av(name: str, *rest: Any) -> Any:
        if name.split(".")[0] == "av":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without_av)
    error_of(run_folder, "needs PyAV", 'pip install "telerig[video]"')


def paged_tiff(frame: NDArray[np.uint8], count: int) -> bytes:
    """A TIFF of pages whose first pixel counts, put together by hand: header, pixels, header..."""
    height, width = frame.shape
    out = [b"II*\0" + struct.pack("<I", 8 + frame.size)]
    at = 8
    for k in range(count):
        tags = [(256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, at), (277, 1),
                (278, height), (279, frame.size)]  # fmt: skip
        head = struct.pack("<H", len(tags)) + b"".join(
            struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags
        )
        at += frame.size + len(head) + 4
        following = at + frame.size if k < count - 1 else 0
        pixels = bytes([k % 251]) + frame.tobytes()[1:]
        out += [pixels, head, struct.pack("<I", following)]
    return b"".join(out)


def test_memory_stays_flat_over_10_000_pages(tmp_path: Path) -> None:
    (tmp_path / "left.tif").write_bytes(paged_tiff(movie(1)[0], 10_000))
    source = PageFrames(tmp_path / "left.tif")
    assert len(source) == 10_000
    assert [source.read(k)[0, 0] for k in range(100)] == list(range(100))
    tracemalloc.start()
    for k in range(0, 10_000, 25):
        assert source.read(k)[0, 0] == k % 251
    gc.collect()
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 10 * WIDTH * HEIGHT, "bytes that 400 reads leave behind"


# --- what a run's folder must be ---------------------------------------------------------------


def test_a_dataset_loads_its_runs(full_run: Path) -> None:
    dataset = load_dataset(full_run.parent.parent, need_views=False)
    assert_frames(dataset.runs["rise"].load(), "left", LEFT)


def test_bare_folder_with_cameras_of_a_calibration(full_run: Path, tmp_path: Path) -> None:
    bare = full_run.rename(tmp_path / "bare")
    error_of(bare, "no rig.toml two folders up", "--calibration")
    run = load_run(bare, cameras=CAMERAS, image_sizes_px=SIZES)
    assert run.rig is None and run.cameras == CAMERAS
    assert_frames(run, "right", RIGHT)
    assert load_run(bare, cameras=CAMERAS).image_sizes_px == SIZES, "from the images"
    sizes = SIZES | {"right": (50, 32)}
    error_of(bare, "is 48 x 32 px, expected 50 x 32", cameras=CAMERAS, image_sizes_px=sizes)


def test_wrong_paths(full_run: Path) -> None:
    error_of(full_run.parent / "rize", "there is no such run", "did you mean rise?")
    error_of(full_run / "run.toml", "is a file")


def test_nothing_in_the_folder(run_folder: Path) -> None:
    error_of(run_folder, "no images", "left/*.tif")
    error_of(run_folder, "no detections.csv", source="detections")


def test_camera_without_frames(run_folder: Path) -> None:
    write_images(run_folder / "left", LEFT)
    error_of(run_folder, "camera right has no frames", "right.avi")


def test_frames_of_an_unknown_camera(full_run: Path) -> None:
    write_images(full_run / "rigth", LEFT)
    error_of(full_run, "there is no camera 'rigth'", "did you mean right?")


def test_two_recordings_of_one_camera(full_run: Path) -> None:
    tifffile.imwrite(full_run / "left.tif", LEFT)
    error_of(full_run, "left", "left.tif", "keep one")


def test_the_same_frame_twice(full_run: Path) -> None:
    tifffile.imwrite(full_run / "left" / "000002.tiff", LEFT[2])
    error_of(full_run, "000002.tif and 000002.tiff are the same frame twice")


def test_multi_page_file_within_a_camera_folder(run_folder: Path) -> None:
    for camera in CAMERAS:
        (run_folder / camera).mkdir()
        tifffile.imwrite(run_folder / camera / "all.tif", LEFT)
    error_of(run_folder, "holds 6 frames", "move it to left.tif")


@pytest.mark.parametrize("kind", ["images", "pages", "video"])
def test_image_size_of_another_rig(kind: str, run_folder: Path) -> None:
    small = movie(3)[:, :-2]
    for camera in CAMERAS:
        if kind == "images":
            write_images(run_folder / camera, small)
        elif kind == "pages":
            tifffile.imwrite(run_folder / f"{camera}.tif", small, photometric="minisblack")
        else:
            frames = np.ascontiguousarray(movie(3))
            write_video(run_folder / f"{camera}.avi", frames, "ffv1", "gray")
            rig = run_folder.parent.parent / "rig.toml"
            rig.write_text(RIG.replace("[48, 32]", "[48, 34]"))
    expected = "is 48 x 32 px, expected 48 x 34" if kind == "video" else "is 48 x 30 px, expected"
    error_of(run_folder, expected, "left", "image_size_px")


def test_size_that_changes_within_the_run(full_run: Path) -> None:
    tifffile.imwrite(full_run / "left" / "000003.tif", LEFT[3][:, :-1])
    run = load_run(full_run, skip_unreadable=True)
    with pytest.raises(InputError, match=r"000003\.tif: is 47 x 32 px, expected 48 x 32"):
        run.image("left", 3)


def test_no_such_camera_or_frame(full_run: Path) -> None:
    run = load_run(full_run)
    with pytest.raises(InputError, match="did you mean left"):
        run.image("lefft", 0)
    with pytest.raises(InputError, match="there is no frame 6"):
        run.image("left", 6)
    with pytest.raises(InputError, match="there is no frame -1"):
        run.image("left", -1)


# --- truncated and unreadable ------------------------------------------------------------------


def cut(file: Path, keep: float = 0.6) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: int(keep * len(data))])


def test_truncated_last_image_is_noted(full_run: Path) -> None:
    cut(full_run / "left" / "000005.tif")
    run = load_run(full_run)
    assert run.frame_count == 6
    assert run.image("left", 5) is None
    assert run.image("right", 5) is not None
    (note,) = run.notes
    assert "camera left, frame 5" in note and "truncated" in note and "000005.tif" in note
    error_of(full_run, "000005.tif", "truncated", skip_unreadable=False)


def test_truncated_image_within_the_run(full_run: Path) -> None:
    cut(full_run / "left" / "000002.tif")
    run = load_run(full_run)
    with pytest.raises(InputError, match=r"000002\.tif: is truncated"):
        run.image("left", 2)
    run = load_run(full_run, skip_unreadable=True)
    assert run.image("left", 2) is None and run.image("left", 2) is None
    assert len(run.notes) == 1 and "frame 2" in run.notes[0]


@pytest.mark.parametrize("imagej", [True, False])
def test_truncated_multi_page(imagej: bool, run_folder: Path) -> None:
    for camera in CAMERAS:
        with tifffile.TiffWriter(run_folder / f"{camera}.tif", imagej=imagej) as writer:
            if imagej:
                writer.write(LEFT)
            for frame in () if imagej else LEFT:
                writer.write(frame, contiguous=False, metadata=None)
    left = run_folder / "left.tif"
    full = left.read_bytes()
    last = full.find(LEFT[5].tobytes())
    assert last > 0
    left.write_bytes(full[: last + 100])
    run = load_run(run_folder)
    assert run.frame_count == 6 and run.image("left", 5) is None
    assert any("camera left, frame 5" in note for note in run.notes)
    np.testing.assert_array_equal(run.image("left", 4), LEFT[4])
    error_of(run_folder, "left.tif (page 5", "truncated", skip_unreadable=False)
    left.write_bytes(full[: last // 2])
    if imagej:
        run = load_run(run_folder)
        with pytest.raises(InputError, match=r"page 4, from 0.: is truncated"):
            run.image("left", 4)
    else:
        error_of(run_folder, "the cameras differ in their frames", "right 6")


def test_file_that_is_no_tiff(run_folder: Path) -> None:
    (run_folder / "left.tif").write_bytes(b"not an image at all")
    tifffile.imwrite(run_folder / "right.tif", RIGHT)
    error_of(run_folder, "left.tif", "no TIFF header")


def test_truncated_video(run_folder: Path) -> None:
    frames = movie(20)
    for camera in CAMERAS:
        write_video(run_folder / f"{camera}.avi", frames, "rawvideo", "gray")
    full = (run_folder / "left.avi").read_bytes()
    at = full.find(frames[19].tobytes()[:64])
    assert at > 0
    (run_folder / "left.avi").write_bytes(full[: at + 100])
    run = load_run(run_folder, pair_by="order")
    assert run.frame_count == 20 and run.image("left", 19) is None and run.notes
    np.testing.assert_array_equal(run.image("left", 18), frames[18])
    (run_folder / "left.avi").write_bytes(b"RIFF nothing")
    error_of(run_folder, "left.avi", "cannot be opened as a video")


# --- frames that one camera misses -------------------------------------------------------------


def test_a_missing_number_is_a_missing_frame(full_run: Path) -> None:
    (full_run / "right" / "000001.tif").unlink()
    (full_run / "right" / "000005.tif").unlink()
    run = load_run(full_run)
    assert run.frame_count == 6
    assert [image is None for image in run.frames_of("right")] == [0, 1, 0, 0, 0, 1]
    np.testing.assert_array_equal(run.image("right", 2), RIGHT[2])
    assert run.notes == ["camera right misses 2 frames: 1, 5"]


def test_a_number_that_both_cameras_miss_keeps_its_time(full_run: Path) -> None:
    for camera in CAMERAS:
        (full_run / camera / "000003.tif").unlink()
    run = load_run(full_run)
    assert run.frame_count == 6 and run.image("left", 3) is None
    np.testing.assert_array_equal(run.image("left", 4), LEFT[4])
    assert run.t_s[4] == pytest.approx(2.04)


def test_counts_that_differ_without_numbers(run_folder: Path) -> None:
    tifffile.imwrite(run_folder / "left.tif", LEFT)
    tifffile.imwrite(run_folder / "right.tif", RIGHT[:4], photometric="minisblack")
    error_of(run_folder, "the cameras differ in their frames: left 6, right 4", "missing")
    run = load_run(run_folder, pair_by="order")
    assert run.frame_count == 6 and run.image("right", 4) is None
    error_of(run_folder, "do not count the frames", pair_by="numbers")


def test_counters_of_their_own(run_folder: Path) -> None:
    write_images(run_folder / "left", LEFT, range(100, 106))
    write_images(run_folder / "right", RIGHT, range(700, 706))
    assert_frames(load_run(run_folder), "right", RIGHT)


def test_counters_off_by_one_are_not_guessed(run_folder: Path) -> None:
    write_images(run_folder / "left", LEFT, range(6))
    write_images(run_folder / "right", RIGHT, range(1, 7))
    error_of(run_folder, "start differently: left at 0 and right at 1", "--pair-by numbers")
    assert load_run(run_folder, pair_by="order").frame_count == 6
    run = load_run(run_folder, pair_by="numbers")
    assert run.frame_count == 7 and run.image("right", 0) is None
    np.testing.assert_array_equal(run.image("right", 1), RIGHT[0])


def test_frames_csv_says_what_is_missing(run_folder: Path) -> None:
    tifffile.imwrite(run_folder / "left.tif", LEFT)
    tifffile.imwrite(run_folder / "right.tif", RIGHT[[0, 1, 3, 4, 5]])
    text = "frame,t_s,missing\n0,0,\n1,0.01,\n2,0.02,right\n3,0.03,\n4,0.04,\n5,0.05,{}\n"
    (run_folder / "frames.csv").write_text(text.format("left"))
    run = load_run(run_folder)
    assert run.image("right", 2) is None and run.image("left", 5) is None
    np.testing.assert_array_equal(run.image("right", 3), RIGHT[3])
    (run_folder / "frames.csv").write_text(text.format("right|up"))
    error_of(run_folder, "frames.csv row 7, column missing", "'up'")
    (run_folder / "frames.csv").write_text(text.format("right"))
    error_of(run_folder, "camera right has 5 images; frames.csv has 6 rows, 2 of them")


# --- times and the stage -----------------------------------------------------------------------


def times(rows: str) -> str:
    return "frame,t_s\n" + rows


GOOD = "0,0\n1,.1\n2,.2\n3,.3\n4,.4\n5,.5\n"
BAD_TIMES = [
    ("shorter", "0,0\n1,.1\n2,.2\n", ("row 4", "images of 6 frames: frame 3 has no time")),
    ("longer", GOOD + "6,.6\n7,.7\n", ("row 8, column frame", "is 6", "end with frame 5")),
    ("stands still", GOOD.replace("3,.3", "3,.2"), ("row 5, column t_s", "not later than 0.2 s")),
    ("back", GOOD.replace("3,.3", "3,.15"), ("row 5, column t_s", "times must increase")),
    ("twice", GOOD.replace("4,.4", "3,.4"), ("row 6, column frame", "3 stands twice")),
    ("gap", GOOD.replace("3,.3\n", ""), ("row 5, column frame", "the time of frame 3")),
    ("unsorted", "1,.1\n0,.0\n2,.2\n3,.3\n4,.4\n5,.5\n", ("row 3, column frame", "sort")),
    ("negative", "-1,0\n" + GOOD, ("row 2, column frame", "is -1, before 0")),
    ("nan", GOOD.replace(".3", "nan"), ("row 5, column t_s", "not a finite number")),
    ("blank", GOOD.replace(".3", ""), ("row 5, column t_s", "is blank")),
    ("words", GOOD.replace(".3", "soon"), ("row 5, column t_s", "'soon'")),
    ("half", GOOD.replace("3,", "3.5,"), ("row 5, column frame", "not a whole number")),
]


@pytest.mark.parametrize(
    ("rows", "words"), [b[1:] for b in BAD_TIMES], ids=[b[0] for b in BAD_TIMES]
)
def test_bad_frames_csv(rows: str, words: tuple[str, ...], full_run: Path) -> None:
    (full_run / "frames.csv").write_text(times(rows))
    error_of(full_run, "frames.csv", *words)


def test_frames_csv_wins_over_run_toml(full_run: Path) -> None:
    (full_run / "frames.csv").write_text(times(GOOD))
    run = load_run(full_run)
    np.testing.assert_allclose(run.t_s, np.arange(6) / 10)
    assert "frames.csv, not of run.toml" in run.notes[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frame_rate_hz = 0", ("frame_rate_hz", "is 0, not positive")),
        ("start_s = 1.0", ("frame_rate_hz", "is missing")),
        ("frame_rate = 100", ("frame_rate", "did you mean frame_rate_hz?")),
        ('frame_rate_hz = "100 Hz"', ("'100 Hz', not a finite number",)),
        ("frame_rate_hz = nan", ("nan, not a finite number",)),
        ("frame_rate_hz 100", ("not valid TOML",)),
    ],
)
def test_bad_run_toml(text: str, words: tuple[str, ...], full_run: Path) -> None:
    (full_run / "run.toml").write_text(text)
    error_of(full_run, "run.toml", *words)


def test_no_times_at_all(full_run: Path) -> None:
    (full_run / "run.toml").unlink()
    error_of(full_run, "neither frames.csv nor run.toml", "frame_rate_hz")
    for camera in CAMERAS:
        for k in range(1, 6):
            (full_run / camera / f"{k:06d}.tif").unlink()
    run = load_run(full_run)
    assert run.t_s.tolist() == [0.0] and "only frame" in run.notes[0]


def test_stage_at_mid_exposure(full_run: Path) -> None:
    (full_run / "stage.csv").write_text("t_s,position_mm,flag\n1.99,10,a\n2.01,20,b\n2.06,25,c\n")
    run = load_run(full_run)
    assert run.stage is not None and run.stage["flag"].tolist() == ["a", "b", "c"]
    np.testing.assert_allclose(run.positions_on_record_mm(), [15, 20, 21, 22, 23, 24], rtol=1e-12)


def test_frames_outside_the_stage_record(full_run: Path) -> None:
    (full_run / "stage.csv").write_text("t_s,position_mm\n2.005,1\n2.035,2\n")
    run = load_run(full_run)
    assert run.position_mm is not None
    assert np.isnan(run.position_mm).tolist() == [1, 0, 0, 0, 1, 1]
    assert "3 frames (0 to 5)" in run.notes[0] and "outside the record" in run.notes[0]
    with pytest.raises(InputError) as caught:
        run.positions_on_record_mm()
    checked(str(caught.value), "stage.csv", "2 s to 2.05 s", "clocks")


def test_silent_stage_is_noted(full_run: Path) -> None:
    rows = [f"{t:.3f},0" for t in [*np.arange(1.99, 2.012, 0.001), 2.06]]
    (full_run / "stage.csv").write_text("t_s,position_mm\n" + "\n".join(rows))
    (note,) = load_run(full_run).notes
    assert "silent for 0.048 s from 2.012 s" in note


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("1,0\n", ("single row",)),
        ("1,0\n1,1\n2,2\n", ("row 3, column t_s", "not later than 1 s")),
        ("1,0\n2,x\n", ("row 3, column position_mm", "'x'")),
    ],
)
def test_bad_stage_csv(rows: str, words: tuple[str, ...], full_run: Path) -> None:
    (full_run / "stage.csv").write_text("t_s,position_mm\n" + rows)
    error_of(full_run, "stage.csv", *words)


def test_accelerometers(full_run: Path) -> None:
    head = "t_s,sensor,ax_m_s2,ay_m_s2,az_m_s2\n"
    file = full_run / "accelerometer.csv"
    file.write_text(head + "0,arm_left,0,9.81,0\n0.001,arm_left,0.1,9.8,0\n")
    table = load_run(full_run).accelerometers
    assert table is not None and table["ay_m_s2"].tolist() == [9.81, 9.8]
    file.write_text(head + "0,arm_leff,0,9.81,0\n")
    error_of(full_run, "row 2, column sensor", "did you mean arm_left?")
    file.write_text(head + "0,arm_left,0,9.81,0\n0,arm_left,0,9.81,0\n")
    error_of(full_run, "row 3, column t_s", "sort the rows by time")


def test_references(full_run: Path) -> None:
    head = "frame,camera,mark,u_px,v_px\n"
    file = full_run / "references.csv"
    file.write_text(head + "0,left,a,3,4\n0,right,a,5,6\n5,left,b,7,8\n")
    table = load_run(full_run).references
    assert table is not None and table["mark"].tolist() == ["a", "a", "b"]
    assert table["svv_px2"].tolist() == pytest.approx([0.01] * 3)
    file.write_text(head + "0,left,a,3,4\n0,left,a,5,6\n")
    error_of(full_run, "references.csv row 3, column mark", "'a' stands twice in frame 0")
    file.write_text(head + "6,left,a,3,4\n")
    error_of(full_run, "row 2, column frame", "is 6, the last is 5")


# --- detections in place of images -------------------------------------------------------------

HEAD = "frame,camera,u_px,v_px,sigma_px,particle,a_px,b_px,angle_rad,contrast,word\n"
ROWS = """0,left,10,12,0.2,007,5,4,0.1,0.8,x
0,right,11,12,0.4,007,,,,0.7,y
2,left,9,8,.2,,5,4,0,.5,z
"""


def detections(folder: Path, text: str) -> Path:
    (folder / "detections.csv").write_text(text)
    return folder


def test_detections(run_folder: Path) -> None:
    run = load_run(detections(run_folder, HEAD + ROWS))
    table = run.detections
    assert run.source == "detections" and table is not None and run.frame_count == 3
    assert table["particle"].tolist() == ["007", "007", ""], "given ids stay as they are"
    np.testing.assert_allclose(table["suu_px2"], [0.04, 0.16, 0.04])
    np.testing.assert_allclose(table["suv_px2"], 0.0)
    assert table["contrast"].tolist() == [0.8, 0.7, 0.5] and table["word"].tolist() == list("xyz")
    assert np.isnan(table["a_px"][1]) and table["b_px"][0] == 4
    assert table.attrs["sigma_known"] is True
    with pytest.raises(InputError, match="it has no images"):
        run.image("left", 0)


def test_least_detections(run_folder: Path) -> None:
    (run_folder / "frames.csv").write_text(times(GOOD))
    run = load_run(detections(run_folder, "frame,camera,u_px,v_px\n1,left,10,12\n"))
    assert run.frame_count == 6, "as frames.csv has it"
    assert run.detections is not None
    assert run.detections["svv_px2"].tolist() == [0.25]
    assert run.detections.attrs["sigma_known"] is False
    assert "detections.csv has nothing of camera right" in run.notes


def test_full_covariance(run_folder: Path) -> None:
    head = "frame,camera,u_px,v_px,suu_px2,suv_px2,svv_px2\n"
    run = load_run(detections(run_folder, head + "0,left,10,12,.04,.01,.09\n"))
    assert run.detections is not None
    row = run.detections.iloc[0]
    assert (row["suu_px2"], row["suv_px2"], row["svv_px2"]) == (0.04, 0.01, 0.09)
    error_of(detections(run_folder, head + "0,left,10,12,.04,.1,.09\n"), "is no covariance")


def test_images_and_detections(full_run: Path) -> None:
    detections(full_run, HEAD + ROWS)
    error_of(full_run, "both images and detections.csv", "--from images or --from detections")
    assert_frames(load_run(full_run, source="images"), "left", LEFT)
    assert load_run(full_run, source="detections").frame_count == 3
    error_of(full_run, "source is 'both'", source="both")


def change(old: str, new: str) -> str:
    assert old in ROWS
    return HEAD + ROWS.replace(old, new, 1)


BAD_DETECTIONS = [
    ("camera", change("0,right", "0,rigth"), ("row 3, column camera", "did you mean right?")),
    ("right of it", change("10,12", "52,12"), ("row 2, column u_px", "outside the image of 48 px")),
    ("above it", change("10,12", "10,-4"), ("row 2, column v_px", "outside the image of 32 px")),
    ("nan", change("10,12", "nan,12"), ("row 2, column u_px", "not a finite number")),
    ("text", change("10,12", "10,middle"), ("row 2, column v_px", "'middle'")),
    ("negative frame", change("2,left", "-2,left"), ("row 4, column frame", "before 0")),
    ("half frame", change("2,left", "2.5,left"), ("row 4, column frame", "not a whole number")),
    ("sigma", change("0.2,007", "0,007"), ("row 2, column sigma_px", "is 0, not positive")),
    ("twice", change("0,right", "0,left"), ("row 3, column particle", "'007' stands twice")),
    ("axes", change("5,4,0.1", "4,5,0.1"), ("row 2, column a_px", "less than b_px = 5")),
    ("one axis", change("5,4,0.1", "5,,0.1"), ("row 2, column a_px", "no pair of semi-axes")),
    ("ragged", change(",x\n", "\n"), ("row 2", "has 10 cells, the header has 11")),
    ("no column", "frame,camera,u_px\n0,left,3\n", ("row 1", "missing column: v_px")),
    ("empty", "frame,camera,u_px,v_px\n", ("no rows below its header",)),
]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "words"), [b[1:] for b in BAD_DETECTIONS], ids=[b[0] for b in BAD_DETECTIONS]
)
def test_bad_detections(text: str, words: tuple[str, ...], run_folder: Path) -> None:
    error_of(detections(run_folder, text), "detections.csv", *words)


def test_detections_beyond_frames_csv(run_folder: Path) -> None:
    (run_folder / "frames.csv").write_text(times("0,0\n1,.1\n"))
    error_of(detections(run_folder, HEAD + ROWS), "row 4, column frame", "is 2, the last is 1")


def test_detections_without_a_rig(run_folder: Path, tmp_path: Path) -> None:
    bare = detections(run_folder, HEAD + ROWS).rename(tmp_path / "bare")
    run = load_run(bare, cameras=CAMERAS)
    assert isinstance(run.detections, pd.DataFrame) and "sizes are not known" in run.notes[0]
    run = load_run(bare, cameras=CAMERAS, image_sizes_px=SIZES)
    assert run.notes == []
