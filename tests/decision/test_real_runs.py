"""Diagnoses of the real runs of 2024-10-03, whose healthy halves also calibrated the twin."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from failuretwin import BayesDiagnoser, ReadOptions, read_runs
from failuretwin.inference.faults.priors import priors_of

BOTH = pytest.mark.parametrize("how", ["measured", "published"])


@pytest.fixture(scope="module")
def real(data, armpi):
    folder = data / "real_robot_b_20241003"
    return {how: read_runs(folder, armpi, ReadOptions(how, True)) for how in BOTH.args[1]}


@pytest.fixture(scope="module")
def diagnose(twin, real):
    """Diagnose the runs in one form, once for each range of errors [servo units]."""

    @cache
    def run(how, error_range=None):
        priors = priors_of(twin.robot, error_range, None)
        return BayesDiagnoser(twin, priors=priors).diagnose(real[how])

    return run


def right(diagnoses):
    assert len(diagnoses) == 90
    return sum(d.truth == d.diagnosis for d in diagnoses)


@BOTH
def test_at_least_84_of_90_in_sample(diagnose, how):
    assert right(diagnose(how)) >= 84


@BOTH
def test_at_least_84_of_90_with_known_error_range_in_sample(diagnose, how):
    assert right(diagnose(how, (4, 21))) >= 84


@pytest.mark.parametrize(("how", "most"), [("measured", 1), ("published", 2)])
def test_false_alarms_in_ten_healthy_runs_in_sample(diagnose, how, most):
    """Gaps drawn out by straight lines can look like a motor that stops."""
    healthy = [d for d in diagnose(how) if d.truth == "healthy"]
    assert sum(d.diagnosis != "healthy" for d in healthy) <= most


@BOTH
def test_angle_of_frozen_motors_is_found_in_sample(real, diagnose, how):
    truth = real[how]["magnitude"].values
    errors = [
        abs(d.magnitude - truth[i])
        for i, d in enumerate(diagnose(how))
        if d.truth == d.diagnosis and "stuck" in d.truth
    ]
    assert len(errors) >= 30
    assert np.rad2deg(np.median(errors)) < 1.0


def test_readings_drawn_out_by_lines_make_nobody_surer_in_sample(diagnose):
    """Both forms hold the same readings, so neither may be much surer than the other."""
    surprise = {
        how: -np.mean([np.log(d.posterior[d.truth]) for d in diagnose(how)])
        for how in ("measured", "published")
    }
    assert all(0.0 < value < 0.3 for value in surprise.values())
    assert abs(surprise["measured"] - surprise["published"]) < 0.3
