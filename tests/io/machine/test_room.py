"""Work for which the computer has too little memory, or the disk too little room."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import telerig
from telerig.errors import InputError
from telerig.io.files.csv_table import Column, read_table
from telerig.io.machine import room
from telerig.io.simulation import simulate as simulate_module
from telerig.io.simulation.presets import run_preset
from telerig.scripts.main import app


def test_the_memory_is_what_the_system_says() -> None:
    stated = Path("/proc/meminfo")
    if not stated.is_file():
        pytest.skip("Linux alone says it in a file")
    total = 1024.0 * int(stated.read_text(encoding="utf-8").split()[1])
    assert 0 < room.memory_bytes() <= total * 1.001


def test_a_container_may_use_less(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, limit = room.memory_bytes(), tmp_path / "memory.max"
    monkeypatch.setattr(room, "_LIMITS", (limit, tmp_path / "missing"))
    limit.write_text("1000000\n", encoding="utf-8")
    assert room.memory_bytes() == 1e6
    limit.write_text("max\n", encoding="utf-8")
    assert room.memory_bytes() >= whole


@pytest.mark.parametrize("option", ["--frames", "--bubbles", "--references", "--stage-axis"])
def test_a_simulation_that_does_not_fit_is_refused_before_it_begins(
    option: str, tmp_path: Path
) -> None:
    out = tmp_path / "set"
    command = ["simulate", "rise", "--out", str(out), option, "100000000000"]
    for images in ("--images", "--no-images"):
        done = CliRunner().invoke(app, [*command, images])
        said = " ".join(done.output.split())
        assert done.exit_code == 2, said
        assert "simulation 'rise': needs " in said and "fewer frames" in said
    assert not list(tmp_path.iterdir())


def test_the_disk_of_a_folder_that_is_not_there_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "new" / "set"
    assert room.free_bytes(folder) > 0
    monkeypatch.setattr(room, "free_bytes", {folder: 2e6}.__getitem__)
    room.check_room("here", "less", disk=1.9e6, folder=folder)
    with pytest.raises(InputError, match=r"needs 2\.1 MB on the disk, 2 MB are free") as caught:
        room.check_room("here", "less", disk=2.1e6, folder=folder)
    assert caught.value.todo == "less, or make room on the disk"


@pytest.mark.parametrize(
    ("name", "bubbles", "images"), [("rise", 1, False), ("S1", 20, False), ("rise", 1, True)]
)
def test_a_simulation_takes_a_little_more_than_is_expected(
    name: str, bubbles: int, images: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = dict[str, float]()
    monkeypatch.setattr(
        simulate_module, "check_room", lambda *_, **room: asked.update(disk=room["disk"])
    )
    config = run_preset(name, frames=5 if images else 60, bubbles=bubbles)
    telerig.simulate(config, rng=np.random.default_rng(1), out=tmp_path, images=images)
    taken = sum(file.stat().st_size for file in tmp_path.rglob("*") if file.is_file())
    assert 0.4 * taken < asked["disk"] < taken


def test_a_table_larger_than_the_memory_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "tracks.csv"
    file.write_text("frame\n" + "1\n" * 1000, encoding="utf-8")
    assert len(read_table(file, [Column("frame")])) == 1000
    monkeypatch.setattr(room, "memory_bytes", lambda: 2500.0)
    with pytest.raises(InputError, match="of memory") as caught:
        read_table(file, [Column("frame")])
    assert caught.value.where == str(file)
