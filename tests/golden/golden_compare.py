"""Nested values side by side: what differs, and where."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

import numpy as np

GONE = "nothing"


def plain(value):
    """Return a value as JSON holds it: dicts, lists, text, numbers, truth and nothing."""
    if isinstance(value, dict):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


@dataclass(frozen=True)
class Tolerance:
    """By how much numbers may differ: by a share of them, of those below `floor` by that of it."""

    share: float
    floor: float = 1.0

    def allows(self, got, expected):
        return bool(abs(got - expected) <= self.share * max(self.floor, abs(expected)))


def differences(got, expected, tolerance, where=()):
    """Return a line for each difference, such as ``run > hypothesis: got 1, expected 2``."""
    if isinstance(got, dict) and isinstance(expected, dict):
        names = [*expected, *(name for name in got if name not in expected)]
        both = [(name, got.get(name, GONE), expected.get(name, GONE)) for name in names]
    elif isinstance(got, list) and isinstance(expected, list) and len(got) == len(expected):
        both = [(i, *pair) for i, pair in enumerate(zip(got, expected, strict=True))]
    else:
        same = _same(got, expected, tolerance)
        place = " > ".join(map(str, where))
        return [] if same else [f"{place}: got {got!r}, expected {expected!r}"]
    return [line for name, a, b in both for line in differences(a, b, tolerance, (*where, name))]


def _same(got, expected, tolerance):
    if not all(isinstance(x, Real) and not isinstance(x, bool) for x in (got, expected)):
        return type(got) is type(expected) and got == expected
    if np.isnan(expected) or np.isinf(expected):
        return bool(np.array_equal(got, expected, equal_nan=True))
    return tolerance.allows(got, expected)
