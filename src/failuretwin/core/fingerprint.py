"""Values as canonical JSON: equal values give equal text, whatever process writes it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

PLAIN = (str, bool, int, float, type(None))


def canonical(value: Any) -> Any:
    """Return `value` as what JSON can hold, with the type of every dataclass beside its fields.

    Args:
        value: Plain values, arrays, mappings with text as keys, sequences and dataclasses of
            these, all the way down. Paths count for nothing: where a file lies says not what is
            in it.

    Raises:
        TypeError: If there is anything else in it, which could change unseen.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: canonical(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"type": type(value).__name__, **fields}
    if isinstance(value, PLAIN):
        return value
    if isinstance(value, Path):
        return None
    if isinstance(value, np.ndarray | np.generic):
        return canonical(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): canonical(item) for key, item in value.items()}
    if isinstance(value, tuple | list | range):
        return [canonical(item) for item in value]
    raise TypeError(f"no canonical form of {value!r}: make {type(value).__name__} a dataclass.")


def fingerprint(value: Any) -> str:
    """Return the SHA-256 of the canonical JSON of `value`, 64 hexadecimal digits."""
    text = json.dumps(canonical(value), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
