"""Outlines drawn over images."""

from __future__ import annotations

import numpy as np
import pytest
from tracked_folder import outline

from telerig.errors import InputError
from telerig.io.report.overlays import draw_bubble_overlay


def test_overlay_draws_each_outline_where_it_is() -> None:
    image = np.full((200, 300), 180, np.uint16)
    rings = [outline(80.5, 90.25, 30), outline(210.0, 100.0, 20)]
    colours = [(10, 250, 20), (20, 30, 250)]
    picture = draw_bubble_overlay(image, rings, ["", ""], colours)
    assert picture.dtype == np.uint8 and picture.shape[1:] == (300, 3) and len(picture) > 200
    for channel, other, (u, v), radius in (
        (1, 2, (80.5, 90.25), 30.0),
        (2, 1, (210.0, 100.0), 20.0),
    ):
        excess = picture[:200, :, channel].astype(int) - picture[:200, :, other]
        rows, columns = np.nonzero(excess > 60)
        np.testing.assert_allclose(np.hypot(columns - u, rows - v), radius, atol=1.3)
        assert columns.mean() == pytest.approx(u, abs=0.2)
    half = draw_bubble_overlay(image, rings, ["7", "8"], colours, max_width_px=150)
    assert half.shape[1] == 150


def test_overlay_tells_why_something_was_rejected() -> None:
    image = np.full((120, 200), 90.0)
    dust = [(50.0, 40.0, 6.0, "too small"), (150.0, 60.0, float("nan"), "too small")]
    bare = draw_bubble_overlay(image, [], [])
    told = draw_bubble_overlay(image, [], [], rejected=dust)
    assert len(told) > len(bare) > 120
    rows, columns = np.nonzero(told[:120, :, 0].astype(int) - told[:120, :, 1] > 60)
    assert {tuple(p) for p in np.c_[columns, rows] // 100} >= {(0, 0), (1, 0)}
    with pytest.raises(InputError, match="grey image"):
        draw_bubble_overlay(np.zeros((4, 4, 3)), [], [])
    with pytest.raises(ValueError, match="shorter"):
        draw_bubble_overlay(image, [outline(5, 5, 3)], [])
