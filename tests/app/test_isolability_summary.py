from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from failuretwin.app.reports.isolability_report import group_lines, size_lines
from failuretwin.inference.isolability import IsolabilityReport

BIAS, SCALE, STUCK = "motor_1:encoder_bias", "motor_1:encoder_scale", "motor_2:stuck"


def found(groups, detected, isolated):
    """What can be told apart of two faults of 0.1 (rad or a ratio), considered up to 0.4."""
    return IsolabilityReport(
        hypotheses=("healthy", BIAS, SCALE, STUCK),
        nats=np.zeros((4, 4)),
        groups=groups,
        detected=dict(zip((BIAS, SCALE), detected, strict=True)),
        isolated=dict(zip((BIAS, SCALE), isolated, strict=True)),
        typical=dict.fromkeys((BIAS, SCALE), 0.1),
        largest=dict.fromkeys((BIAS, SCALE), 0.4),
    )


def test_what_looks_alike_is_said_with_the_size_that_is_meant(armpi):
    said = group_lines(
        found([("healthy", BIAS), (SCALE, STUCK)], (None, None), (None, None)), armpi
    )
    assert said == [
        "cannot be told apart by such motions when faults are as large as this: "
        "healthy or motor 1 has a shifted zero by 5.7 deg; "
        "motor 1 has a wrong scale by 10 % or motor 2 stuck"
    ]
    held = group_lines(found([("healthy", STUCK)], (None, None), (None, None)), armpi)
    assert held == ["cannot be told apart by such motions: healthy or motor 2 stuck"]
    assert group_lines(found([], (None, None), (None, None)), armpi) == []


def test_the_smallest_sizes_are_said_and_what_never_shows(armpi):
    assert size_lines(found([], (0.05, 0.2), (0.1, None)), armpi) == [
        "smallest faults that such motions show: motor 1 has a shifted zero by 5.7 deg",
        "not shown for certain, even when as large as this: motor 1 has a wrong scale by 40 %",
        "of these, that something is wrong shows from this size on: "
        "motor 1 has a wrong scale by 20 %",
    ]
    assert size_lines(found([], (None, None), (None, None)), armpi) == [
        "not shown for certain, even when as large as this: "
        "motor 1 has a shifted zero by 22.9 deg, motor 1 has a wrong scale by 40 %"
    ]


def test_a_slide_is_spoken_of_in_millimetres():
    slide = SimpleNamespace(own_unit=lambda motor, unit: unit.replace("rad", "m"))
    said = group_lines(found([("healthy", BIAS)], (None, None), (None, None)), slide)
    assert "shifted zero by 100.0 mm" in said[0]
