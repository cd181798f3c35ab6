"""A rig.toml with every table, and what is made of it."""

from __future__ import annotations

import pytest

from telerig.errors import InputError
from telerig.io.rig_file.description import RigDescription
from telerig.io.rig_file.rig_file import description_from_toml

FULL = """
schema = 1
name = "tank 2"
[cameras.left]
image_size_px = [640, 512]
scale_px_per_mm = 10.0
telecentricity_per_mm = 0.0
[cameras.right]
image_size_px = [512, 512]
scale_px_per_mm = 11
[stereo]
right_from_left_rotvec_deg = [0.0, 90.0, 0.0]
[target]
layout = "grid"
rows = 3
columns = 5
pitch_mm = 7.0
dot_diameter_mm = 2.4
polarity = "white_on_black"
marks = [[1, 2], [1, 3], [0, 2]]
mark_style = "large"
mark_diameter_mm = 3.6
extent = "bounded"
print_sigma_mm = 0.03
scale_dots = [0, 14]
scale_distance_mm = 31.305
scale_sigma_mm = 0.001
[stage]
axis_left = [0.0, -2.0, 0.0]
position_sigma_mm = 0.005
[accelerometers.arm_left]
mounted_on = "left"
axes = [[1,0,0],[0,1,0],[0,0,3]]
noise_density_ug_sqrt_hz = 22.5
bias_sigma_m_s2 = 0.2
[references]
kind = "dots"
polarity = "black_on_white"
dot_diameter_mm = 1.0
[walls.left]
normal = [0.0, 0.3, -0.4]
indices = [1.0, 1.52, 1.333]
thickness_mm = 10.0
"""


def parse(text: str) -> RigDescription:
    return description_from_toml(text, where="rig.toml")


def changed(old: str, new: str) -> str:
    assert FULL.count(old) >= 1, old
    return FULL.replace(old, new, 1)


def error_of(text: str) -> str:
    with pytest.raises(InputError) as caught:
        parse(text)
    return str(caught.value)


UNBOUNDED = changed('extent = "bounded"', 'extent = "unbounded"')
