"""Values that are arrays with named axes, against what is done to each array by hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest

from failuretwin.core.types import ArrayStruct, Axes, BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Within(ArrayStruct):
    start: Annotated[FloatArray, Axes("run", "movement", empty=np.nan)]


@dataclass(frozen=True)
class Sample(ArrayStruct):
    within: Within
    first: Annotated[IntArray, Axes("run", "motor", empty=-1)]
    seen: Annotated[BoolArray, Axes("run", "movement", empty=False)]
    place: Annotated[FloatArray, Axes("run", "movement", "axis")]
    parts: tuple[Within, ...]
    shared: str


@pytest.fixture
def sample():
    """Two runs of three movements."""
    start = np.arange(6.0).reshape(2, 3)
    return Sample(
        within=Within(start),
        first=np.array([[7, 8], [9, 10]]),
        seen=np.array([[True, False, True], [False, True, True]]),
        place=np.arange(18.0).reshape(2, 3, 3),
        parts=(Within(start + 10.0), Within(start + 20.0)),
        shared="same",
    )


def test_a_run_loses_its_axis(sample):
    run = sample[1]
    assert run.within.start.tolist() == [3.0, 4.0, 5.0]
    assert run.first.tolist() == [9, 10]
    assert run.parts[1].start.tolist() == [23.0, 24.0, 25.0]
    assert run.shared == "same"


def test_movements_are_taken_where_there_are_any(sample):
    some = sample[[1], :2]
    assert some.within.start.tolist() == [[3.0, 4.0]]
    assert some.first.tolist() == [[9, 10]]  # has no movements
    items = sample[np.array([0, 1, 1]), np.array([2, 0, 1])]
    assert items.place.tolist() == [[6.0, 7.0, 8.0], [9.0, 10.0, 11.0], [12.0, 13.0, 14.0]]
    assert items.first.tolist() == [[7, 8], [9, 10], [9, 10]]


def test_empty_holds_what_stands_for_nothing():
    empty = Within.empty(run=2, movement=1)
    assert np.isnan(empty.start).all()
    assert empty.start.shape == (2, 1)


def test_blank_keeps_all_but_the_entries(sample):
    blank = sample.blank(4, 5)
    assert [blank.place.shape, blank.first.shape] == [(4, 5, 3), (4, 2)]
    assert blank.parts[0].start.shape == (4, 5)
    assert [blank.first.dtype, blank.seen.dtype] == [np.int64, bool]
    assert (blank.first == -1).all()
    assert not blank.seen.any()
    assert (blank.place == 0.0).all()
    assert blank.shared == "same"


def test_what_is_put_is_what_is_taken(sample):
    blank = sample.blank(3, 4)
    blank.put((np.array([2, 0]), slice(1, 4)), sample)
    assert blank.within.start[2].tolist()[1:] == [0.0, 1.0, 2.0]
    assert blank.parts[1].start[0].tolist()[1:] == [23.0, 24.0, 25.0]
    assert blank.first.tolist() == [[9, 10], [-1, -1], [7, 8]]
    assert np.isnan(blank.within.start[1]).all()


def test_the_oldest_movement_is_forgotten(sample):
    sample.forget_oldest(np.array([0]))
    assert sample.within.start[0].tolist()[:2] == [1.0, 2.0]
    assert np.isnan(sample.within.start[0, 2])
    assert sample.seen.tolist() == [[False, True, False], [False, True, True]]
    assert sample.place[0].tolist() == [[3.0, 4.0, 5.0], [6.0, 7.0, 8.0], [0.0, 0.0, 0.0]]
    assert sample.first.tolist() == [[7, 8], [9, 10]]
    assert sample.parts[0].start[1].tolist() == [13.0, 14.0, 15.0]


def test_movements_come_behind_others(sample):
    both = sample.extended_by(sample[:, :1])
    assert both.seen.tolist() == [[True, False, True, True], [False, True, True, False]]
    assert both.parts[1].start[1].tolist() == [23.0, 24.0, 25.0, 23.0]
    assert both.first.tolist() == sample.first.tolist()  # has no movements


def test_saved_arrays_come_back(sample):
    saved = {name: array.copy() for name, array in sample.to_arrays("some").items()}
    assert sorted(saved) == [
        "some/first", "some/parts0/start", "some/parts1/start", "some/place", "some/seen",
        "some/within/start",
    ]  # fmt: skip
    other = sample.blank(2, 3)
    other.from_arrays("some", saved)
    for name, array in other.to_arrays("some").items():
        np.testing.assert_array_equal(array, saved[name])


def test_saved_arrays_must_fit(sample):
    saved = sample.to_arrays("some")
    with pytest.raises(
        ValueError, match=r"some/within/start has shape \(2, 3\), expected \(1, 3\)"
    ):
        sample.blank(1, 3).from_arrays("some", saved)
    del saved["some/place"]
    with pytest.raises(KeyError, match="some/place"):
        sample.blank(2, 3).from_arrays("some", saved)
