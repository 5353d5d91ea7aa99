"""Stored runs, and all that was said of them: what is said now must be the same.

A failure says that results have changed. If that was meant, see `write.py`.
"""

from __future__ import annotations

import json

import pytest
from golden_cases import CASES, outcome
from golden_compare import Tolerance, differences
from write import expected_file

SHOWN = 12


@pytest.mark.parametrize("case", CASES)
def test_what_is_said_of_stored_runs_stays_the_same(case):
    expected = json.loads(expected_file(case).read_text("utf-8"))
    found = differences(outcome(case), expected, CASES[case].tolerance)
    lines = "\n".join(f"{case} > {line}" for line in found[:SHOWN])
    assert not found, f"{len(found)} differences:\n{lines}"


def test_every_stored_expectation_has_its_case():
    files = {expected_file(case) for case in CASES}
    assert set(expected_file("").parent.iterdir()) == files


@pytest.mark.parametrize(
    ("got", "expected", "line"),
    [
        ({"a": {"b": 1.0}}, {"a": {"b": 2.0}}, "a > b: got 1.0, expected 2.0"),
        ({"a": [1.0, 2.0]}, {"a": [1.0]}, "a: got [1.0, 2.0], expected [1.0]"),
        ({}, {"a": 1}, "a: got 'nothing', expected 1"),
        ({"a": "x"}, {}, "a: got 'x', expected 'nothing'"),
        (["stuck"], ["slow"], "0: got 'stuck', expected 'slow'"),
        ([float("nan")], [1.0], "0: got nan, expected 1.0"),
        ([None], [0.0], "0: got None, expected 0.0"),
        ([1.0 + 1e-8], [1.0], "0: got 1.00000001, expected 1.0"),
        ([100.0 + 1e-6], [100.0], "0: got 100.000001, expected 100.0"),
    ],
)
def test_a_difference_is_told_with_its_place(got, expected, line):
    assert differences(got, expected, Tolerance(1e-9)) == [line]


def test_small_figures_differ_by_less():
    assert differences([1e-3 + 1e-8], [1e-3], Tolerance(1e-6, floor=0.01)) == []
    assert differences([1e-3 + 2e-8], [1e-3], Tolerance(1e-6, floor=0.01)) != []


def test_what_is_the_same_to_rounding_has_no_difference():
    got = {"a": [1.0 + 1e-10, -1e5 * (1 + 1e-10), float("nan"), float("-inf"), "x", None, True]}
    expected = {"a": [1, -1e5, float("nan"), float("-inf"), "x", None, True]}
    assert differences(got, expected, Tolerance(1e-9)) == []
