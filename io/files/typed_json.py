"""Numbers, arrays, mappings and dataclasses as JSON, and back again by their types."""

from __future__ import annotations

import base64
import dataclasses
import types
from collections.abc import Mapping
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

_ARRAY, _MAPPING = "array", "mapping"


def packed(value: Any) -> Any:
    """Return a value as what `json` writes, bit by bit; a tuple or dataclass is a list."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [packed(getattr(value, f.name)) for f in dataclasses.fields(value)]
    if isinstance(value, np.ndarray):
        content = base64.b64encode(value.tobytes()).decode()
        return {_ARRAY: [value.dtype.str, list(value.shape), content]}
    if isinstance(value, Mapping):
        return {_MAPPING: [[packed(k), packed(v)] for k, v in value.items()]}
    if isinstance(value, tuple | list):
        return [packed(v) for v in value]
    return value.item() if isinstance(value, np.generic) else value


def unpacked(kind: Any, value: Any) -> Any:
    """Return the value of a type, such as a dataclass or ``Mapping[str, Array]``, that was packed.

    Raises ValueError, TypeError or KeyError for what is no such value.
    """
    if isinstance(value, dict) and _ARRAY in value:
        dtype, shape, content = value[_ARRAY]
        return np.frombuffer(base64.b64decode(content), np.dtype(dtype)).reshape(shape).copy()
    parts = get_args(kind)
    if get_origin(kind) in (Union, types.UnionType):
        (kind,) = (part for part in parts if part is not type(None))
        return None if value is None else unpacked(kind, value)
    if isinstance(value, dict):
        of_key, of_value = parts or (Any, Any)
        return {unpacked(of_key, k): unpacked(of_value, v) for k, v in value[_MAPPING]}
    if isinstance(value, list):
        if kind is Any:
            return [unpacked(Any, v) for v in value]
        if get_origin(kind) is tuple:
            each = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
            return tuple(unpacked(k, v) for k, v in zip(each, value, strict=True))
        hints = get_type_hints(kind)
        return kind(*(unpacked(k, v) for k, v in zip(hints.values(), value, strict=True)))
    return value
