"""Values of many types through JSON and back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest

from telerig.arrays import Array
from telerig.io.files.typed_json import packed, unpacked


class _Named(NamedTuple):
    camera: str
    hz: float | None


@dataclass(frozen=True)
class _Sums:
    total: Array
    ends: tuple[float, float]
    by: Mapping[tuple[str, str], _Named]
    counts: Mapping[int, Array | None]
    parts: tuple[Array, ...]
    rest: Mapping[str, Any]


def test_what_comes_back_is_what_was_written() -> None:
    sums = _Sums(
        np.array([[0.1, np.inf], [np.nan, 1 / 3]]), (1.5, -np.inf),
        {("bubbles", "x"): _Named("left", None), ("marks", ""): _Named("right", 9.5)},
        {3: np.zeros((0, 3)), 4: None}, (np.arange(3.0), np.ones((2, 2))),
        {"one": [1, {"deep": np.arange(2)}], "two": None, "three": np.float64(0.25)},
    )  # fmt: skip
    back = unpacked(_Sums, json.loads(json.dumps(packed(sums))))
    np.testing.assert_array_equal(back.total, sums.total)
    assert back.ends == sums.ends
    assert back.by == sums.by
    assert isinstance(back.by["marks", ""], _Named)
    assert back.counts[3].shape == (0, 3)
    assert back.counts[4] is None
    assert [p.shape for p in back.parts] == [(3,), (2, 2)]
    assert back.rest["one"][1]["deep"].tolist() == [0, 1]
    assert back.rest["three"] == 0.25
    back.total[0, 0] = 7.0  # it can be changed, as the one that was written


def test_another_value_is_refused() -> None:
    with pytest.raises(ValueError, match="zip"):
        unpacked(_Named, ["left"])
