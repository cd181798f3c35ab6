"""Points of a simulated run are compared with the bubbles that are there."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from telerig.estimator.tracking.truth import matched


@pytest.mark.parametrize(
    ("whole", "off_px", "sd_px", "shown"),
    [
        (1, 2.0, 0.1, True),
        (1, 5.0, 4.0, False),
        (0, 2.0, 0.1, True),
        (0, 5.0, 4.0, True),
        (0, 5.0, 0.1, False),
        (0, 13.0, 4.0, False),
    ],
)
def test_a_cut_bubble_is_shown_within_the_stated_error(
    whole: int, off_px: float, sd_px: float, shown: bool
) -> None:
    pixels = {f"{c}_{x}_px": [100.0] for c in ("left", "right") for x in "uv"}
    spread = {f"{c}_s{x}{x}_px2": [sd_px**2] for c in ("left", "right") for x in "uv"}
    table = pd.DataFrame({"frame": [0], **pixels, **spread})
    truth = pd.DataFrame({"frame": [0], **pixels, "left_whole": [whole], "right_whole": [1]})
    truth["left_u_px"] += off_px
    bubble, right = matched(table, truth, ["left", "right"])
    assert bubble["row"].notna().tolist() == [shown]
    np.testing.assert_array_equal(right, [shown and whole == 1])
