from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import special, stats

from failuretwin.connection.calibration.calibrate import exclude_suspect_runs, fit_calibration
from failuretwin.connection.calibration.parameters import (
    Rate,
    rate_parameter,
    settling_parameters,
    spring_remarks,
    zero_remarks,
)
from failuretwin.connection.calibration.settling_fit import SettlingPosterior
from failuretwin.connection.calibration.timing_fit import joint_doubt
from failuretwin.core.hypothesis import HEALTHY
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.nonidealities import Timing

COUNT = np.deg2rad(0.24)


# Rates


@pytest.mark.parametrize("mean_hits", [0.3, 1.0, 3.0, 10.0])
@pytest.mark.parametrize("trials", [25, 400])
def test_interval_of_a_rate_holds_the_truth_wherever_it_was_seen(mean_hits, trials):
    hits, rate = np.arange(1, trials + 1), mean_hits / trials
    chance = stats.binom.pmf(hits, trials, rate)
    likely = hits[chance > 1e-9]
    intervals = np.array([Rate(int(h), trials).interval for h in likely])
    inside = (intervals[:, 0] <= rate) & (rate <= intervals[:, 1])
    assert 0.93 < chance[likely - 1] @ inside / chance.sum() < 0.99


def test_interval_of_an_often_seen_rate_is_nearly_that_of_the_jeffreys_posterior():
    below = special.betainc(60.5, 340.5, Rate(60, 400).interval)
    np.testing.assert_allclose(below, [0.025, 0.975], atol=5e-4)
    assert Rate(60, 400).mean == pytest.approx(60.5 / 401.0, rel=1e-15)


def test_what_was_never_seen_is_bounded_but_not_called_identified():
    never = rate_parameter("lost commands", "motor_3", Rate(0, 150))
    assert not never.identified
    assert never.low == 0.0
    assert 0.005 < never.high < 0.03
    assert never.note == "never seen in 150 cases, so 1.7 % at most; it takes longer logs"
    once = rate_parameter("lost commands", "motor_3", Rate(1, 150))
    assert once.identified
    assert once.low == 0.0


# Tails


def tails(dof, log_deviation, armpi):
    mode, deviation = np.zeros(17), np.full(17, 1e-3)
    mode[-1], deviation[-1] = np.log(dof), log_deviation
    fit = SettlingPosterior(mode, np.diag(deviation**2), np.ones(17))
    return settling_parameters(fit, armpi, 0.0)[-1]


def test_the_interval_of_the_tails_is_even_about_their_inverse(armpi):
    found = tails(5.0, 0.2, armpi)
    assert found.identified
    assert 1.0 / found.low + 1.0 / found.high == pytest.approx(2.0 / found.value, rel=1e-12)
    assert 1.0 / found.low - 1.0 / found.high == pytest.approx(2 * 1.96 * 0.2 / 5.0, rel=1e-4)


def test_tails_may_be_those_of_a_normal_scatter(armpi):
    assert tails(15.0, 0.6, armpi).high == np.inf
    wide = tails(2.5, 0.5, armpi)
    assert not wide.identified
    assert "hundred movements" in wide.note


# What does not fit a healthy robot


def test_a_compliance_below_zero_is_remarked_upon(armpi):
    mode, deviation = np.zeros(17), np.full(17, 1e-3)
    mode[4:8] = [-1e-12, -0.05, 0.1, -0.2]  # gravity does not load motor 1
    fit = SettlingPosterior(mode, np.diag(deviation**2), np.ones(17))
    remarks = spring_remarks(settling_parameters(fit, armpi, 0.0))
    assert [remark.partition(":")[0] for remark in remarks] == [
        "compliance of motor_2",
        "compliance of motor_4",
    ]
    assert "-0.05 rad/(N m) (-0.052 to -0.048) is negative" in remarks[0]


def test_a_zero_that_is_off_is_remarked_upon(armpi):
    """What hobby servos are off by, 0.37 deg, is not."""
    mode, deviation = np.zeros(17), np.full(17, 1e-3)
    mode[:4] = np.deg2rad([0.5, -5.0, 1.5, 1.9])
    fit = SettlingPosterior(mode, np.diag(deviation**2), np.ones(17))
    (remark,) = zero_remarks(settling_parameters(fit, armpi, 0.0), armpi)
    assert remark.startswith("bias of motor_2: it stands -5.0 deg off (-5.1 to -4.9)")


def test_a_session_with_many_suspect_runs_is_left_out_as_a_whole():
    names = [f"{session}/{run}" for session in "ab" for run in range(10)] + ["alone"]
    sessions = ["a"] * 10 + ["b"] * 10 + ["alone"]
    doubt = np.zeros(21)
    doubt[[0, 1]] = 0.95  # two of ten: by chance
    doubt[[10, 14, 17]] = 0.9
    doubt[20] = 1.0
    found = exclude_suspect_runs(names, sessions, doubt)
    assert [entry.run for entry in found] == ["a/0", "a/1", *names[10:20], "alone"]
    assert {entry.movement for entry in found} == {0}
    assert found[0].reason == found[-1].reason == "looks faulty"
    assert {e.reason for e in found[2:12]} == {"its session looks faulty, in 3 of 10 runs"}


def test_a_perfect_arm_is_seen_to_be_one_by_its_tool_alone(armpi):
    runs = simulate(Plan(armpi, [HEALTHY], 8, 1)).drop_vars("position", errors="ignore")
    found = fit_calibration(runs, armpi, "ideal", "made up", thorough=False)
    settling = found.imperfections.settling
    # The tool is believed to be seen with some noise, which here it has none of.
    assert np.max(np.abs([settling.bias, settling.friction])) < 0.5 * COUNT
    assert max(settling.scatter) < COUNT
    assert not any(p.identified for p in found.parameters if p.name == "tail_dof")


# Timing


def test_doubt_about_the_lag_is_doubt_about_the_delay():
    """Delays that fall as the lag rises are as unsure as the lag is, and as their own spread."""
    rng, runs = np.random.default_rng(0), 60
    best, own = rng.normal(0.04, 0.008, runs), rng.normal(0.01, 0.003, runs)
    lags = best.mean() + 0.004 * np.array([[-1.0], [0.0], [1.0]])
    costs = (lags - best) ** 2
    values = np.stack([own - lags, np.zeros((3, runs))], axis=2)
    delay, shortening, lag = joint_doubt(values, costs, 0.004, float(best.mean()))
    half = stats.t.ppf(0.975, runs - 1) / np.sqrt(runs)
    assert lag == pytest.approx(half * np.std(best, ddof=1), rel=1e-9)
    assert delay == pytest.approx(half * np.std(own - best, ddof=1), rel=1e-9)
    assert shortening == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("tool", [pytest.param(False, marks=pytest.mark.slow), True])
def test_sag_on_the_way_is_not_taken_for_delay(armpi, measured_armpi, tool):
    still = replace(measured_armpi.settling, scatter=(5e-4,) * 4)
    real = replace(
        measured_armpi,
        settling=still,
        timing=Timing(delay_s=(0.015, 0.015), ramp_shortening=(0.02, 0.02), lag_s=(0.03, 0.03)),
        lost_commands=(),
        readings=replace(measured_armpi.readings, whole_counts=False, glitch_rate=()),
    )
    runs = simulate(Plan(armpi, [HEALTHY], 8, 3, real))
    runs = runs.drop_vars("position") if tool else runs
    found = fit_calibration(runs, armpi, "trial", "made up", thorough=False)
    by_name = {p.name: p for p in found.parameters}
    # As if sag were spread evenly over a ramp, they would be off by up to 2.5, 1.3 ms and 0.3 %.
    assert by_name["lag"].value == pytest.approx(0.03, abs=2e-3 if tool else 1e-3)
    assert by_name["delay, mean over runs"].value == pytest.approx(0.015, abs=1e-3)
    shortening = by_name["ramp shortening, mean over runs"].value
    assert shortening == pytest.approx(0.02, abs=1.2e-3)
