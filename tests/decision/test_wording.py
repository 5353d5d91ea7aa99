from __future__ import annotations

import pytest

from failuretwin.core.diagnosis import Diagnosis
from failuretwin.core.hypothesis import HEALTHY, Hypothesis
from failuretwin.decision.wording import verdict


def said(text, magnitude):
    best = Hypothesis.parse(text)
    posterior = {text: 0.97, "healthy": 0.03}
    return verdict(Diagnosis(run="run", posterior=posterior, magnitude=magnitude), [best, HEALTHY])


@pytest.mark.parametrize(
    ("text", "magnitude", "words"),
    [
        ("motor_1:encoder_scale", -0.25, "motor 1 has a wrong scale by -25%, 97 % sure"),
        ("motor_2:encoder_bias", 0.5, "motor 2 has a shifted zero by +28.6 deg, 97 % sure"),
        ("motor_3:stuck", -0.5, "motor 3 stuck at -29 deg since before the run, 97 % sure"),
        ("motor_4:drift", 0.02, "motor 4 drifts by +1.15 deg/s, 97 % sure"),
        ("motor_4:lag", 0.2, "motor 4 late by 0.20 s, 97 % sure"),
    ],
)
def test_sizes_are_told_in_their_own_unit(text, magnitude, words):
    assert said(text, magnitude) == words


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("unknown", "something that none of the known faults explains, 97 % sure"),
        ("motor_1:stuck+motor_2:drift", "motor 1 stuck and motor 2 drifts, 97 % sure"),
    ],
)
def test_no_size_is_told_where_there_is_none(text, words):
    assert said(text, None) == words
