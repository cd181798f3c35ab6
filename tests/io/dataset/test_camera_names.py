"""One rule for the names of cameras: what rig.toml refuses is not written either."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rig_text import changed, error_of

from telerig.errors import InputError
from telerig.io.dataset.new_dataset import NewCamera, new_dataset
from telerig.io.exchange.importing.pinhole import Pinhole, cameras_from_pinholes
from telerig.io.rig_file.camera_names import camera_name_faults
from telerig.io.rig_file.rig_file import read_rig_toml
from telerig.io.tables.smoothing import SHAKE
from telerig.rig.pose import Pose

PAIRS = [
    ("left", "left cam"), ("left", "a,b"), ("left", "Carriage"), ("all", "left"),
    ("left", "Left"), ("ide", "side"), ("side", "ide"), ("1", "s1"),
]  # fmt: skip


def imported(names: tuple[str, ...]) -> None:
    matrix = np.array([[9000.0, 0, 255], [0, 9000.0, 255], [0, 0, 1]])
    turned = Pose.from_rotvec([0.0, 1.2, 0.0], [0.0, 0.0, 0.0]).rotation
    files = [
        Pinhole(f"{i}.yml", (512, 512), matrix, rotation, np.array([0.0, 0, 450]), np.zeros(12))
        for i, rotation in enumerate((np.eye(3), turned))
    ]
    cameras_from_pinholes(files, names)


@pytest.mark.parametrize("names", PAIRS)
def test_names_that_rig_toml_refuses_are_refused_where_they_are_first_given(
    names: tuple[str, str], tmp_path: Path
) -> None:
    text = changed("[cameras.right]", f'[cameras."{names[1]}"]').replace("right_", "other_")
    text = text.replace("[cameras.left]", f'[cameras."{names[0]}"]')
    (fault,) = camera_name_faults(names)
    assert fault.what in error_of(text)
    for give in (
        imported,
        lambda names: new_dataset(tmp_path / "new", [NewCamera(n) for n in names]),
    ):
        with pytest.raises(InputError) as caught:
            give(names)
        assert fault.what in str(caught.value)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    "names",
    [("ide", "side"), ("ss", "s"), ("x", "y", "sx"), ("left", "right"), ("sleft", "right-s")],
)
def test_names_that_would_share_a_column_are_refused_and_no_others(names: tuple[str, ...]) -> None:
    columns = SHAKE.names(names)
    assert bool(camera_name_faults(names)) == (len(set(columns)) < len(columns))


def test_names_of_any_language_can_be_given(tmp_path: Path) -> None:
    names = ("Zähler-1", "名前")
    rig, *_ = new_dataset(tmp_path / "new", [NewCamera(name) for name in names])
    assert tuple(read_rig_toml(rig).cameras) == names
    imported(names)
