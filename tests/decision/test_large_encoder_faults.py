"""Encoder faults so large that the arm hangs in quite another pose than it was told to."""

from __future__ import annotations

import numpy as np
import pytest

from failuretwin import BayesDiagnoser, Priors, SetupPrior
from failuretwin.core.hypothesis import parse_hypotheses, single_faults
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.failure_behavior.modes import EncoderBias, EncoderScale

LARGE = {
    "encoder_bias": EncoderBias(magnitude=(0.4, 0.7), onset_s=(0.0, 0.0)),
    "encoder_scale": EncoderScale(magnitude=(0.4, 0.7), onset_s=(0.0, 0.0)),
}


@pytest.fixture(scope="module")
def found(twin, armpi, measured_armpi):
    """Runs of motors 2 and 3, which carry the most, and what is said of them."""
    states = parse_hypotheses(
        [f"motor_{k}:{mode}" for mode in LARGE for k in (2, 3)], twin.robot.motor_names
    )
    runs = simulate(Plan(armpi, states, 15, 1, measured_armpi, modes=LARGE))
    hypotheses = single_faults(armpi.motor_names, ("stuck", *LARGE))
    priors = Priors(setup=SetupPrior.known())
    said = BayesDiagnoser(twin, measured_armpi, hypotheses, priors).diagnose(runs)
    return list(zip(said, runs["magnitude"].values, strict=True))


@pytest.mark.parametrize("mode", LARGE)
def test_they_are_found(found, mode):
    right = [d.truth == d.diagnosis for d, _ in found if mode in d.truth]
    assert len(right) == 30
    assert sum(right) >= 28


def of(found, mode):
    return [(d, size) for d, size in found if d.truth == d.diagnosis and mode in d.truth]


def test_a_constant_error_lies_in_its_interval(found):
    """Nine in ten of some 30 runs: fewer than 23 would be a chance of 1 in 100.

    The interval of a normal distribution is 4.9 times as wide as its errors are at the median.
    """
    said = of(found, "encoder_bias")
    inside = [d.magnitude_90[0] <= size <= d.magnitude_90[1] for d, size in said]
    assert 23 <= sum(inside) <= 0.97 * len(inside)  # reached: 24 of 30


@pytest.mark.parametrize(("mode", "most"), [("encoder_bias", 0.008), ("encoder_scale", 0.02)])
def test_sizes_are_found(found, mode, most):
    """Sag in the commanded pose instead of the real one would be off by 0.018 rad."""
    assert np.median([abs(d.magnitude - size) for d, size in of(found, mode)]) < most
