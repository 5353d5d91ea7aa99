"""What runs say of a healthy motor, of one that is off and of one that misses movements.

Against sums and integrals over all that is unknown.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy import integrate
from slide_runs import (
    NOISE_M,
    OUTLIERS,
    PERIOD_S,
    PLAIN,
    SCATTER_M,
    STARTS_S,
    TARGETS,
    told,
)

from failuretwin.digital_model.nonidealities import LostCommand
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.faults.fault_models import (
    growing_offset_model,
    offset_model,
    redrawn_offset_model,
    transient_model,
)
from failuretwin.inference.faults.fault_sizes import SizePrior
from failuretwin.inference.faults.marginal import marginal_likelihood
from failuretwin.inference.faults.missed_movements import missed_movements_likelihood


def test_a_healthy_slide_has_the_density_of_student(run_on):
    """One movement in a hundred may end anywhere within reach; else S = J scatter^2 J^T + noise."""
    likelihood, brute = run_on([0.1, -0.2, 0.25], [0.1, -0.19, 0.15])
    expected = np.log([brute.healthy(m) for m in range(3)])
    np.testing.assert_allclose(likelihood.log_healthy[0], expected, atol=1e-9)


# Off by an amount of its own in each movement.

COUNT_RAD = np.deg2rad(0.24)
CONSIDERED = {name: SizePrior.even([mode.considered]) for name, mode in MODES.items()}
USUAL_RANGES = tuple((k * COUNT_RAD, 5 * k * COUNT_RAD) for k in (4, 7, 10))


def first_affected(ends, early=0.9):
    """Chance that each movement is the first spoilt, by when what spoils it may begin last [s]."""
    length = np.diff([0.0, *ends])
    return (1.0 - early) * length / length.sum() + early * np.eye(1, len(ends))[0]


@pytest.mark.parametrize(
    "off", [(0.04, -0.06, 0.05, -0.03), (0.0, 0.0, 0.12, -0.1), (0.19, 0.2, -0.15, 0.17)]
)
def test_errors_drawn_anew_have_the_evidence_of_all_sizes(run_on, off):
    """4 to 20, 7 to 35 or 10 to 50 counts, the same for all movements from the first one on."""
    likelihood, brute = run_on(TARGETS, np.add(TARGETS, off))
    total = 0.0
    for low, high in USUAL_RANGES:
        size = np.linspace(low, high, 4001)
        each = [
            integrate.trapezoid(brute.at(m, t + size) + brute.at(m, t - size), size)
            / (2 * (high - low))
            for m, t in enumerate(TARGETS)
        ]
        for first, chance in enumerate(first_affected(STARTS_S)):
            total += chance / 3 * brute.before(first) * np.prod(each[first:])
    found = told(
        marginal_likelihood(
            likelihood,
            redrawn_offset_model(
                likelihood, 0, MODES["steady_state_error"], SizePrior.even(USUAL_RANGES), 0.9
            ),
        )
    )
    assert found == pytest.approx(np.log(total), abs=0.05)


@pytest.mark.parametrize("count", [3, 6])
def test_the_size_of_errors_has_the_quantiles_of_their_rms(run_on, count):
    """By draws: each error is normal about what was seen, within its range."""
    rng = np.random.default_rng(count)
    normal = replace(PLAIN, settling=replace(PLAIN.settling, tail_dof=np.inf))
    targets = rng.uniform(-0.2, 0.2, count)
    off = rng.choice([-1.0, 1.0], count) * rng.uniform(0.045, 0.075, count)
    likelihood, _ = run_on(targets, targets + off, normal)
    size = (
        marginal_likelihood(
            likelihood,
            redrawn_offset_model(
                likelihood, 0, MODES["steady_state_error"], SizePrior.even([(0.01, 0.12)]), 1.0
            ),
        )
        .estimate(0)
        .size
    )
    levels = (0.05, 0.25, 0.5, 0.75, 0.95)
    drawn = off + np.hypot(SCATTER_M, NOISE_M) * rng.normal(size=(400_000, count))
    expected = np.quantile(np.sqrt(np.mean(drawn**2, axis=1)), levels)
    width = expected[-1] - expected[0]
    np.testing.assert_allclose(size.quantiles(levels), expected, atol=0.04 * width)


# Off by one amount for the rest of the run.


def settled_middles():
    """When the tool is seen at rest, by the middle of the last 0.6 s of a plateau [s]."""
    return STARTS_S + PERIOD_S - 0.3


def lasting_by_force(brute, offsets, chance_of_size, early=0.9):
    """Log density of a run with offsets (movement, size) from the first movement spoilt on."""
    total = 0.0
    places = brute.targets[:, None] + offsets
    for first, chance in enumerate(first_affected(settled_middles(), early)):
        total += chance * brute.before(first) * (brute.from_on(first, places) @ chance_of_size)
    return np.log(total)


def uniform(low, high, *, signed):
    """Sizes on a fine grid and their chances."""
    size = np.linspace(low, high, 20001)
    if signed:
        size = np.concatenate([-size[::-1], size])
    return size, np.full(len(size), 1.0 / len(size))


@pytest.mark.parametrize("bias", [0.0, 0.03, -0.08])
@pytest.mark.parametrize("first", [0, 2])
def test_a_constant_error_has_the_evidence_of_all_sizes(run_on, bias, first):
    """0.02 to 0.85, with either sign."""
    stands = np.add(TARGETS, bias * (np.arange(4) >= first))
    stands += [0.002, -0.003, 0.001, 0.0]
    likelihood, brute = run_on(TARGETS, stands)
    size, chance = uniform(0.02, 0.85, signed=True)
    found = told(
        marginal_likelihood(
            likelihood,
            offset_model(
                likelihood,
                0,
                MODES["encoder_bias"],
                CONSIDERED["encoder_bias"],
                0.9,
            ),
        )
    )
    expected = lasting_by_force(brute, np.tile(size, (4, 1)), chance)
    assert found == pytest.approx(expected, abs=0.06)


@pytest.mark.parametrize("scale", [0.1, -0.4])
def test_a_wrong_scale_has_the_evidence_of_all_sizes(run_on, scale):
    """0.03 to 0.75 of the angle, with either sign."""
    likelihood, brute = run_on(TARGETS, np.multiply(TARGETS, 1.0 + scale))
    size, chance = uniform(0.03, 0.75, signed=True)
    found = told(
        marginal_likelihood(
            likelihood,
            offset_model(
                likelihood,
                0,
                MODES["encoder_scale"],
                CONSIDERED["encoder_scale"],
                0.9,
            ),
        )
    )
    assert found == pytest.approx(
        lasting_by_force(brute, np.multiply.outer(TARGETS, size), chance), abs=0.03
    )


@pytest.mark.parametrize("play", [0.03, 0.12])
def test_play_has_the_evidence_of_all_sizes(run_on, play):
    """0.02 to 0.15, half of it on the side that the motor comes from."""
    direction = np.array([1.0, -1.0, 1.0, -1.0])
    likelihood, brute = run_on(TARGETS, TARGETS - 0.5 * play * direction)
    size, chance = uniform(0.02, 0.15, signed=False)
    offsets = np.multiply.outer(-0.5 * direction, size)
    found = told(
        marginal_likelihood(
            likelihood,
            offset_model(likelihood, 0, MODES["backlash"], CONSIDERED["backlash"], 0.9),
        )
    )
    assert found == pytest.approx(lasting_by_force(brute, offsets, chance), abs=0.03)


@pytest.mark.parametrize(("rate", "onset_s"), [(0.02, 0.0), (-0.05, 0.0), (0.03, 3.5)])
def test_a_drift_has_the_evidence_of_all_rates_and_onsets(run_on, rate, onset_s):
    """0.005 to 0.06 a second, either way; three onsets a stretch stand for all of them."""
    middle = settled_middles()
    likelihood, brute = run_on(TARGETS, TARGETS + rate * np.maximum(middle - onset_s, 0.0))
    size, chance = uniform(0.005, 0.06, signed=True)
    ends = [0.0, *middle]
    total = 0.0
    for first in range(4):
        onsets = np.linspace(ends[first], ends[first + 1], 402)[:-1] + 0.5 * ends[1] / 401
        weights = np.full(401, 0.1 * (ends[first + 1] - ends[first]) / middle[-1] / 401)
        if first == 0:
            onsets, weights = np.append(onsets, 0.0), np.append(weights, 0.9)
        for onset, weight in zip(onsets, weights, strict=True):
            since = np.maximum(middle - onset, 0.0)
            places = brute.targets[:, None] + np.multiply.outer(since, size[::20])
            says = brute.from_on(first, places) @ chance[::20] * 20
            total += weight * brute.before(first) * says
    found = told(
        marginal_likelihood(
            likelihood,
            growing_offset_model(likelihood, 0, MODES["drift"], CONSIDERED["drift"], 0.9),
        )
    )
    assert found == pytest.approx(np.log(total), abs=0.1 if onset_s == 0.0 else 0.7)


def test_a_drift_may_begin_at_any_time(run_on):
    """One in ten begin in the run, evenly up to where the last movement is seen at rest."""
    fault_model = growing_offset_model(
        run_on(TARGETS, TARGETS)[0], 0, MODES["drift"], CONSIDERED["drift"], 0.9
    )
    onset, part = fault_model.onsets(0)
    share = np.exp(fault_model.log_prior[0])[..., None] * part
    end = settled_middles()[-1]
    assert share.sum() == pytest.approx(1.0)
    assert np.sum(share * onset) == pytest.approx(0.1 * end / 2.0, rel=0.005)
    assert np.sum(share * onset**2) == pytest.approx(0.1 * end**2 / 3.0, rel=0.01)
    # A third of a stretch, evenly: its deviation is a third of its length over the root of 12.
    spread = np.std(np.broadcast_to(onset, share.shape)[0][np.argmax(share[1].sum(axis=-1))])
    assert spread == pytest.approx(2.0 / 3.0 / np.sqrt(12.0), rel=0.05)


@pytest.mark.parametrize(("share", "done"), [(0.5, 1.0), (0.68, 0.8), (0.85, 0.375)])
def test_a_slow_motor_gets_as_far_as_its_time_goes(run_on, share, done):
    """A ramp of 0.8 s takes 0.8 s / (1 - share), and the next command comes after 2 s."""
    stands, here = [], 0.0
    for target in TARGETS:
        here += done * (target - here)
        stands.append(here)
    likelihood, brute = run_on(TARGETS, stands)
    size = (
        marginal_likelihood(
            likelihood,
            transient_model(likelihood, 0, MODES["slow"], CONSIDERED["slow"], 0.9),
        )
        .estimate(0)
        .size
    )
    sizes = np.linspace(0.15, 0.85, 12)
    np.testing.assert_allclose(np.unique(size.values), sizes)
    expected = np.zeros(12)
    for k, slowness in enumerate(sizes):
        here, places = 0.0, []
        for target, lasts in zip(TARGETS, (2.0, 2.0, 2.0, 1.99), strict=True):
            here += min(lasts * (1.0 - slowness) / 0.8, 1.0) * (target - here)
            places.append(here)
        for first, chance in enumerate(first_affected(STARTS_S)):
            expected[k] += chance * brute.before(first) * brute.from_on(first, np.array(places))
    found = told(
        marginal_likelihood(
            likelihood,
            transient_model(likelihood, 0, MODES["slow"], CONSIDERED["slow"], 0.9),
        )
    )
    assert found == pytest.approx(np.log(expected.mean()), abs=1e-3)
    np.testing.assert_allclose(
        size.weights / size.weights.sum(), expected / expected.sum(), atol=1e-4
    )


# Missing single movements.


def misses_by_force(brute, sizes, stay, midway):
    """Density of a run for each size, over every first movement and every course of events.

    A motor that was hit stays where it stood or ends anywhere on its way; of one that stands on
    its way, any earlier place may have been its last.
    """
    count = len(brute.targets)
    places = np.array([0.0, *brute.targets])
    share = np.linspace(0.05, 0.95, 12)

    def log_transient(m, place):
        return np.mean(brute.at(m, place + share * (brute.targets[m] - place)))

    lying = [np.mean([log_transient(m, p) for p in places[: m + 1]]) for m in range(count)]
    total = np.zeros(len(sizes))
    for first, chance in enumerate(first_affected(STARTS_S)):
        for events in product(("arrives", "stays", "midway"), repeat=count - first):
            at, says = places[first], brute.before(first) * np.ones(len(sizes))
            for m, event in enumerate(events, start=first):
                if event == "arrives":
                    at = brute.targets[m]
                    says = says * np.maximum(1.0 - (stay + midway) * sizes, 1e-6) * brute.at(m, at)
                    continue
                rate = (stay if event == "stays" else midway) * sizes
                if at is None:
                    says = says * rate * lying[m]
                else:
                    says = (
                        says
                        * rate
                        * (brute.at(m, at) if event == "stays" else log_transient(m, at))
                    )
                at = None if event == "midway" else at
            total += chance / len(sizes) * says
    return total


MISSED = {
    "the second": [0.2, 0.2, 0.1, -0.25],
    "the first two": [0.0, 0.0, 0.1, -0.25],
    "the last": [0.2, -0.15, 0.1, 0.1],
    "none": [0.2, -0.15, 0.1, -0.25],
    "halfway": [0.2, 0.02, 0.1, -0.25],
    "halfway twice": [0.2, 0.02, 0.02, -0.25],
}


@pytest.mark.parametrize("stands", MISSED.values(), ids=MISSED)
@pytest.mark.parametrize(
    ("mode", "sizes", "stay", "midway"),
    [
        ("lost_commands", np.linspace(0.2, 1.0, 12), 1.0, 0.0),
        ("intermittent", np.linspace(0.1, 0.9, 12), 0.1, 0.3),
    ],
    ids=["lost_commands", "intermittent"],
)
def test_missed_movements_have_the_evidence_of_all_histories(
    run_on, stands, mode, sizes, stay, midway
):
    likelihood, brute = run_on(TARGETS, stands)
    found = missed_movements_likelihood(likelihood, 0, mode, 0.9)
    expected = misses_by_force(brute, sizes, stay, midway)
    assert told(found) == pytest.approx(np.log(expected.sum()), abs=1e-3)
    size = found.estimate(0).size
    np.testing.assert_allclose(size.values, sizes)
    np.testing.assert_allclose(size.weights, expected / expected.sum(), atol=1e-4)


def test_a_motor_that_loses_a_command_now_and_then_is_healthy(run_on):
    """Commands get lost at their rate; two in a row as often as both do."""
    lossy = replace(PLAIN, lost_commands=(LostCommand(("motor_1",), 0.1, 0.1),))
    likelihood, brute = run_on(TARGETS, [0.2, 0.2, 0.1, -0.25], lossy)
    # 1.0 % are outliers whatever became of the command; the rate of losses is among the others.
    each = []
    for m, before in enumerate([0.0, *TARGETS[:-1]]):
        arrives, stays = (brute.at(m, place) - OUTLIERS for place in (TARGETS[m], before))
        each.append(0.9 * arrives + 0.1 * stays + OUTLIERS)
    np.testing.assert_allclose(likelihood.log_healthy[0, :2], np.log(each[:2]), atol=0.02)
