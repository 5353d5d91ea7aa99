"""Parts of a stream's state as plain arrays, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

Arrays = Mapping[str, np.ndarray]


def arrays_of(part: Any, prefix: str) -> dict[str, np.ndarray]:
    """Return the arrays of a dataclass, and of those in it, by ``prefix/name``.

    Fields with ``saved=False`` in their metadata are left out.
    """
    found: dict[str, np.ndarray] = {}
    for field in dataclasses.fields(part):
        value, name = getattr(part, field.name), f"{prefix}/{field.name}"
        if not field.metadata.get("saved", True):
            continue
        if isinstance(value, np.ndarray):
            found[name] = value
        elif dataclasses.is_dataclass(value):
            found |= arrays_of(value, name)
    return found


def put_arrays(part: Any, prefix: str, arrays: Arrays) -> None:
    """Fill the arrays of a dataclass with what `arrays_of` returned.

    Raises:
        KeyError: If one is missing.
        ValueError: If one is of another shape.
    """
    for name, value in arrays_of(part, prefix).items():
        value[...] = _alike(arrays[name], value.shape, name)


def _alike(value: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    if value.shape != shape:
        raise ValueError(f"{name} has shape {value.shape}, expected {shape}")
    return value
