"""What tests of smoothed runs share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from telerig.estimator.smoothing.graph import accelerations
from telerig.factors.bubble_motion import Inertia, LowPasses


@pytest.fixture(scope="module")
def known_low_passes() -> Iterator[None]:
    """The bubbles' low-pass is given; to learn it takes seconds, and test_accelerations does."""
    known = Inertia((0.01,) * 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(accelerations, "learned_low_passes", lambda *_: LowPasses(known, known))
        yield
