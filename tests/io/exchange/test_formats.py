"""The registry of formats: every line names a function that takes the options it is given."""

from __future__ import annotations

import inspect

import pytest

from telerig.io.exchange.formats import (
    CAMERA_EXPORTS,
    CAMERA_IMPORTERS,
    RECORDINGS,
    RUN_EXPORTS,
    Format,
)

REGISTRIES = (CAMERA_EXPORTS, RUN_EXPORTS, CAMERA_IMPORTERS, RECORDINGS)


@pytest.mark.parametrize("known", [f for registry in REGISTRIES for f in registry.values()])
def test_a_format_names_a_function_that_takes_its_options(known: Format) -> None:
    parameters = inspect.signature(known.load()).parameters
    assert set(known.options) <= set(parameters)
    assert not known.suffix or known.suffix.startswith(".")


def test_no_two_exports_have_one_name() -> None:
    assert not set(CAMERA_EXPORTS) & set(RUN_EXPORTS)
