from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from failuretwin.core.config import canonical, fingerprint


@dataclass(frozen=True)
class Point:
    x: float
    tags: Any = ()


@dataclass(frozen=True)
class Vector:
    x: float
    tags: Any = ()


@pytest.mark.parametrize(
    ("one", "same"),
    [
        (Point(1.0), Point(1.0)),
        ({"a": 1, "b": 2}, {"b": 2, "a": 1}),
        ({"a": 1}, MappingProxyType({"a": 1})),
        ([1, 2], (1, 2)),
        (range(3), [0, 1, 2]),
        (np.array([[1.0, np.inf]]), [[1.0, np.inf]]),
        (np.float64(0.1), 0.1),
        (Path("/here"), Path("/there")),
    ],
)
def test_what_means_the_same_has_the_same_fingerprint(one, same):
    assert fingerprint(one) == fingerprint(same)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (Point(1.0), Point(1.0 + 2**-52)),
        (Point(1.0), Vector(1.0)),
        (Point(1.0, (1, 2)), Point(1.0, (2, 1))),
        ("1", 1),
        (None, "None"),
        ([[1], [2]], [[1, 2]]),
    ],
)
def test_what_differs_has_another_fingerprint(one, other):
    assert fingerprint(one) != fingerprint(other)


def test_canonical_form_survives_json():
    value = canonical(Point(0.1, {"a": (1, None, np.arange(2))}))
    assert value == {"type": "Point", "x": 0.1, "tags": {"a": [1, None, [0, 1]]}}
    assert json.loads(json.dumps(value)) == value


@pytest.mark.parametrize("value", [object(), print, {1, 2}, Point, Callable])
def test_what_could_change_unseen_is_refused(value):
    with pytest.raises(TypeError, match=r"no canonical form of .*: make .* a dataclass"):
        fingerprint({"deep": [value]})
