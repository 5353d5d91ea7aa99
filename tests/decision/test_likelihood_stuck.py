"""A stuck motor, against sums and integrals over all angles and onsets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, stats
from slide_runs import (
    LAG_S,
    PERIOD_S,
    PLAIN,
    RAMP_S,
    SCATTER_M,
    TARGETS,
    told,
)

from failuretwin.digital_model.nonidealities import Timing
from failuretwin.inference.faults.marginal import marginal_likelihood
from failuretwin.inference.faults.priors import OnsetPrior
from failuretwin.inference.faults.stuck import stuck_model
from failuretwin.inference.movements.run_likelihood import RunLikelihood

LOW, HIGH = -0.552, 0.552
"""Where the motor may be held: its travel, 0.46 m either way, and a tenth of that length [m]."""
ANGLES = np.linspace(LOW, HIGH, 55201)


def student(off, scale):
    """Student t of 4 degrees of freedom, up to a constant."""
    return stats.t.pdf(off / scale, 4.0)


def between(low, high):
    """Anywhere on the way, give or take four scatters."""
    inside = (low - 4 * SCATTER_M <= ANGLES) & (high + 4 * SCATTER_M >= ANGLES)
    return inside / (high - low + 8 * SCATTER_M)


def mixed(tied, free):
    """Tied to the commands, or anywhere; what is tied has no mass out of range."""
    density = (1.0 - free) * tied + free / (HIGH - LOW)
    return density / integrate.trapezoid(density, ANGLES)


def stuck_by_force(brute, early=0.5, free=0.2, start=0.0):
    """Density of a run with a motor that gets stuck on a plateau or a ramp, (which, movement)."""
    count = len(brute.targets)
    origin = np.concatenate([[start], brute.targets[:-1]])
    length = np.array([np.full(count, PERIOD_S - RAMP_S), np.full(count, RAMP_S)])
    length[:, 0] = 0.0
    chance = (1.0 - early) * length / length.sum()
    chance[:, 0] = 0.5 * early
    total = np.empty((2, count))
    for m in range(count):
        ends = sorted([origin[m], brute.targets[m]])
        plateau = mixed(student(ANGLES - origin[m], 2 * SCATTER_M) / (2 * SCATTER_M), free)
        held = brute.from_on(m, np.broadcast_to(ANGLES, (count, len(ANGLES))), 0.0)
        for which, prior in enumerate((plateau, mixed(between(*ends), free))):
            says = brute.before(m) * integrate.trapezoid(prior * held, ANGLES)
            total[which, m] = chance[which, m] * says
    return total


HELD = {
    "from the start": [0.0, 0.0, 0.0, 0.0],
    "near the start": [0.025, 0.025, 0.025, 0.025],
    "farther from the start": [-0.06, -0.06, -0.06, -0.06],
    "on the first ramp": [0.12, 0.12, 0.12, 0.12],
    "on the second plateau": [0.2, 0.203, 0.203, 0.203],
    "beside the second plateau": [0.2, 0.232, 0.232, 0.232],
    "on the third ramp": [0.2, -0.15, -0.02, -0.02],
    "just past the third ramp": [0.2, -0.15, -0.165, -0.165],
    "on the last plateau": [0.2, -0.15, 0.1, 0.1],
    "beyond its range": [0.34, 0.34, 0.34, 0.34],
}


@pytest.mark.parametrize("stands", HELD.values(), ids=HELD)
def test_a_stuck_motor_has_the_evidence_of_all_angles_and_onsets(run_on, stands):
    """Half of the probability is before the first plateau or on the first ramp, a fifth free."""
    likelihood, brute = run_on(TARGETS, stands)
    found = told(marginal_likelihood(likelihood, stuck_model(likelihood, 0, OnsetPrior())))
    assert found == pytest.approx(np.log(stuck_by_force(brute).sum()), abs=0.05)


@pytest.mark.parametrize("from_start", [0.0, 0.012, 0.03])
def test_a_stuck_motor_stands_where_a_healthy_one_settles(run_on, from_start):
    """Off by 0.012 and short by 0.005; before the run no one knows which way."""
    biased = replace(PLAIN.settling, bias=(0.012,), friction=(0.005,))
    likelihood, brute = run_on(TARGETS, np.full(4, from_start), replace(PLAIN, settling=biased))
    np.testing.assert_allclose(likelihood.start, [[0.012]])
    brute = replace(brute, targets=np.add(TARGETS, 0.012) - 0.005 * np.array([1, -1, 1, -1]))
    found = told(marginal_likelihood(likelihood, stuck_model(likelihood, 0, OnsetPrior())))
    assert found == pytest.approx(np.log(stuck_by_force(brute, start=0.012).sum()), abs=0.05)


@pytest.mark.parametrize("held", ["from the start", "on the third ramp"])
@pytest.mark.parametrize(("early", "free"), [(0.1, 0.2), (1.0, 0.2), (0.5, 0.6), (0.5, 0.9)])
def test_beliefs_of_a_stuck_motor_count_as_told(run_on, early, free, held):
    likelihood, brute = run_on(TARGETS, HELD[held])
    found = told(
        marginal_likelihood(likelihood, stuck_model(likelihood, 0, OnsetPrior(early, free)))
    )
    expected = np.log(stuck_by_force(brute, early, free).sum())
    assert found == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("off", [0.0, 0.03, 0.09, 0.2])
def test_at_a_known_time_the_angle_is_tied_to_where_the_ramp_was(run_on, off):
    """To within eight scatters, or with a chance of one in twenty to none."""
    known_s, halfway = 4.0 + LAG_S + 0.5 * RAMP_S, 0.5 * (-0.15 + 0.1)
    stands = [0.2, -0.15, halfway + off, halfway + off]
    likelihood, brute = run_on(TARGETS, stands)
    found = told(
        marginal_likelihood(likelihood, stuck_model(likelihood, 0, OnsetPrior(known_s=known_s)))
    )
    prior = mixed(student(ANGLES - halfway, 8 * SCATTER_M) / (8 * SCATTER_M), 0.05)
    held = brute.from_on(2, np.broadcast_to(ANGLES, (4, len(ANGLES))), 0.0)
    total = brute.before(2) * integrate.trapezoid(prior * held, ANGLES)
    assert found == pytest.approx(np.log(total), abs=0.03)


def onset_of(weight):
    """Return onsets [s] of a run and their shares."""
    onset = weight.estimate(0).onset
    return onset.values, onset.weights / onset.weights.sum()


def test_a_motor_stuck_halfway_got_stuck_when_it_was_halfway(run_on):
    """At 4 s + lag + half a ramp of 0.8 s; the lag is known to 18 ms, that of one motor to 30 more.

    Both in steps, the first of 20 ms to 40: 17.7 ms; the second of 15 ms to 60: 27.8 ms.
    """
    likelihood, _ = run_on(TARGETS, [0.2, -0.15, -0.025, -0.025])
    when, share = onset_of(
        marginal_likelihood(likelihood, stuck_model(likelihood, 0, OnsetPrior(free=1e-6)))
    )
    since = when - (4.0 + LAG_S + 0.5 * RAMP_S)
    near = np.abs(since) < 0.2
    assert share[near].sum() > 0.97
    assert share[near] @ since[near] == pytest.approx(0.0, abs=0.002)
    assert np.sqrt(share[near] @ since[near] ** 2) == pytest.approx(
        np.hypot(0.0177, 0.0278), abs=0.002
    )


@pytest.mark.parametrize("late_rate", [0.3, 0.8])
def test_a_ramp_that_may_have_begun_late_ends_late(run_on, late_rate):
    """Half a second to a second and a half, all eleven tenths as likely: a mean of one."""
    timing = Timing(late_rate=late_rate, late_s=(0.5, 1.5))
    likelihood, _ = run_on(TARGETS, [0.2, -0.15, 0.1, -0.075], replace(PLAIN, timing=timing))
    unheard = replace(likelihood.evidence, first_reading_delay=np.full((1, 4), np.nan))
    likelihood = RunLikelihood(unheard, likelihood.model)
    when, share = onset_of(
        marginal_likelihood(likelihood, stuck_model(likelihood, 0, OnsetPrior(free=1e-6)))
    )
    since = when - (6.0 + LAG_S + 0.5 * RAMP_S)
    ramp = since > -0.1
    share = share[ramp] / share[ramp].sum()
    late = since[ramp] > 0.25
    assert share[late].sum() == pytest.approx(late_rate, abs=0.01)
    assert share @ since[ramp] == pytest.approx(late_rate * 1.0, abs=0.004)
    spread = share[late] @ (since[ramp][late] - 1.0) ** 2 / share[late].sum()
    assert np.sqrt(spread) == pytest.approx(0.1 * np.sqrt((11**2 - 1) / 12.0), abs=0.02)


def test_a_motor_stuck_on_a_plateau_may_have_got_stuck_any_time_on_it(run_on):
    """Between the end of the third ramp and the start of the fourth: 4.825 s to 6.025 s."""
    likelihood, brute = run_on(TARGETS, [0.2, -0.15, 0.1, 0.1])
    when, share = onset_of(
        marginal_likelihood(likelihood, stuck_model(likelihood, 0, OnsetPrior()))
    )
    begin, end = 4.0 + LAG_S + RAMP_S, 6.0 + LAG_S
    on = (when > begin + 0.05) & (when < end - 0.05)
    density = stuck_by_force(brute)
    assert share[on].sum() == pytest.approx(density[0, 3] / density.sum(), abs=0.02)
    part = share[on] / share[on].sum()
    assert part @ when[on] == pytest.approx(0.5 * (begin + end), abs=0.01)
    deviation = np.sqrt(part @ (when[on] - 0.5 * (begin + end)) ** 2)
    assert deviation == pytest.approx((end - begin) / np.sqrt(12.0), rel=0.02)


def test_a_motor_that_was_stuck_may_have_been_so_before_the_run(run_on):
    """What is stuck before its first ramp was so at 0 s, but for that time's share of the run."""
    likelihood, brute = run_on(TARGETS, [0.012, 0.012, 0.012, 0.012])
    when, share = onset_of(
        marginal_likelihood(likelihood, stuck_model(likelihood, 0, OnsetPrior()))
    )
    density = stuck_by_force(brute)
    waits = LAG_S / (6.0 + LAG_S + RAMP_S)
    expected = (1.0 - waits) * density[0, 0] / density.sum()
    assert share[when == 0.0].sum() == pytest.approx(expected, abs=0.01)
