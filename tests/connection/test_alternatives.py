from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from failuretwin.core.movements import Movements
from failuretwin.digital_model.nonidealities import Imperfections, LostCommand, Timing
from failuretwin.inference.observation.command_loss import CHANCE_GOAL, STALE_GOAL
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel

OUTLIER_RATE = 0.01

MOTORS = ("motor_1", "motor_2", "motor_3", "motor_4")
SETS = [s for size in (1, 2, 3) for s in combinations(MOTORS, size)]
PERIOD_S, LATE_PERIOD_S = 2.0, 3.0


def movements(late):
    """Return one run whose movement m starts late if `late[m]`; targets are unlike each other."""
    rng = np.random.default_rng(0)
    count = len(late)
    gaps = np.where(late, LATE_PERIOD_S, PERIOD_S)[:-1]
    return Movements(
        initial=rng.uniform(-1, 1, (1, 4)),
        target=rng.uniform(-1, 1, (1, count, 4)),
        ramp_duration=np.full((1, count, 4), 0.8),
        start=np.concatenate([[0.0], np.cumsum(gaps)])[None],
    )


def model(twin, entries, late_rate):
    losses = tuple(LostCommand(*entry) for entry in entries)
    timing = Timing(late_rate=late_rate)
    return HealthyModel(twin, Imperfections("lossy", "test", timing=timing, lost_commands=losses))


entries = st.lists(st.sampled_from(SETS), min_size=1, max_size=4, unique=True).flatmap(
    lambda sets: st.tuples(
        *(st.tuples(st.just(s), st.floats(0.05, 0.2), st.floats(0.05, 0.2)) for s in sets)
    )
)


@given(
    entries=entries,
    late=st.lists(st.booleans(), min_size=1, max_size=4),
    late_rate=st.floats(0.0, 1.0),
)
def test_probabilities_of_all_alternatives_add_up(twin, entries, late, late_rate):
    """In all to one, less outliers; those of the losses of a set to the rate of the set."""
    found = model(twin, entries, late_rate).outcomes(movements(late))
    weights = np.exp(found.log_weight[0]) / (1.0 - OUTLIER_RATE)
    np.testing.assert_allclose(weights.sum(axis=-1), 1.0, rtol=1e-12)
    for motors, rate, when_late in entries:
        same = (found.lost == np.isin(MOTORS, motors)).all(axis=1)
        chance = np.array([*late[:-1], late_rate], dtype=float)
        expected = rate + chance * (when_late - rate)
        np.testing.assert_allclose(weights[:, same].sum(axis=-1), expected, rtol=1e-12)


def test_what_motors_report_to_have_received_counts_as_bayes_says(twin):
    """Every loss by itself: its rate times how probable such reports are if it happened."""
    entries = [(("motor_1",), 0.1, 0.1), (("motor_1", "motor_2"), 0.05, 0.05)]
    known, told = model(twin, entries, 0.0), movements([False])
    outcomes = known.outcomes(told)
    report = np.array([0.0, 1.0, np.nan, 1.0])
    arrived = np.broadcast_to(report, (1, 1, 4))
    silent = np.zeros(outcomes.log_weight.shape)
    late = known.late(told)
    found = known.lost_commands.filtered_outcomes(outcomes, late, silent, arrived)
    weight = np.exp(found.log_weight[0, 0]) / (1.0 - OUTLIER_RATE)

    def probability(lost):
        of_motor = [
            1.0 if np.isnan(came) else (CHANCE_GOAL if gone else 1.0 - STALE_GOAL) if came
            else (1.0 - CHANCE_GOAL if gone else STALE_GOAL)
            for came, gone in zip(report, lost, strict=True)
        ]  # fmt: skip
        return np.prod(of_motor)

    share = {(False,) * 4: 0.85, (True, False, False, False): 0.1, (True, True, False, False): 0.05}
    joint = {lost: rate * probability(lost) for lost, rate in share.items()}
    for lost, expected in joint.items():
        same = (found.lost == lost).all(axis=1)
        total = sum(joint.values())
        np.testing.assert_allclose(weight[same].sum(), expected / total, rtol=1e-6)
    silence = np.full((1, 1, 4), np.nan)
    again = known.lost_commands.filtered_outcomes(outcomes, late, silent, silence)
    np.testing.assert_allclose(again.log_weight, outcomes.log_weight)


@given(motors=st.sampled_from(SETS), lost=st.lists(st.booleans(), min_size=1, max_size=5))
def test_motors_that_miss_commands_in_a_row_stand_where_they_went_last(twin, motors, lost):
    commanded, hit = movements([False] * len(lost)), np.isin(MOTORS, motors)
    found = model(twin, [(motors, 0.2, 0.2)], 0.0).outcomes(commanded)
    origin, target = commanded.origin()[0], commanded.target[0]
    stands, travelled = commanded.initial[0], np.zeros(4)
    for m, missing in enumerate(lost):
        stays = hit & missing
        stands = np.where(stays, stands, target[m])
        travelled = np.where(stays, travelled, np.sign(target[m] - origin[m]))
        same = (found.base[0, m] == stands).all(axis=1) & (found.lost == stays).all(axis=1)
        (at,) = np.flatnonzero(same & np.isfinite(found.log_weight[0, m]))
        np.testing.assert_array_equal(found.direction[0, m, at], travelled)


def test_a_motor_that_missed_two_travelled_last_in_the_movement_before_both(twin):
    commanded = movements([False, False, False])
    found = model(twin, [(("motor_2",), 0.005, 0.005)], 0.0).outcomes(commanded)
    travel = np.sign(commanded.target - commanded.origin())[0, :, 1]
    assert len(found.lost) == 3
    np.testing.assert_array_equal(found.direction[0, 2, :, 1], travel[[2, 1, 0]])


@pytest.mark.parametrize(("share", "count"), [(0.1, 10), (0.3333333335, 3), (1.0, 1)])
def test_motors_may_lose_every_command(twin, share, count):
    """Rates that add up to one, give or take rounding, leave no chance that all arrives."""
    entries = [(motors, share, share) for motors in SETS[:count]]
    found = model(twin, entries, 0.5).outcomes(movements([False, True, False]))
    assert np.exp(found.log_weight[..., 0]).max() < 1e-9
    total = np.exp(found.log_weight).sum(axis=-1)
    np.testing.assert_allclose(total, 1.0 - OUTLIER_RATE, rtol=1e-9)


def test_rare_losses_in_a_row_are_left_out(twin):
    rate = 0.9 * np.sqrt(1e-6)
    found = model(twin, [(("motor_1",), rate, rate)], 0.0).outcomes(movements([False] * 3))
    assert found.lost.tolist() == [[False] * 4, [True, False, False, False]]


def test_a_run_has_the_alternatives_that_it_has_among_others(twin):
    healthy = model(twin, [(("motor_1", "motor_2"), 0.1, 0.2), (("motor_1",), 0.1, 0.1)], 0.3)
    short, long = movements([False, True]), movements([True, False, False, True])
    padded = Movements(
        np.concatenate([short.initial, long.initial]),
        *(
            np.concatenate(
                [
                    np.pad(
                        getattr(short, name),
                        [(0, 0), (0, 2), *[(0, 0)] * (getattr(short, name).ndim - 2)],
                        constant_values=np.nan,
                    ),
                    getattr(long, name),
                ]
            )
            for name in ("target", "ramp_duration", "start")
        ),
    )
    alone, both = healthy.outcomes(short), healthy.outcomes(padded)
    for name in ("base", "direction", "log_weight"):
        np.testing.assert_array_equal(getattr(both, name)[:1, :2], getattr(alone, name))


def test_the_next_travel_begins_where_the_motor_stood(twin):
    """A motor that missed its command travels from the target before that, on any later way."""
    commanded = movements([False] * 4)
    healthy = model(twin, [(("motor_2",), 0.1, 0.1)], 0.0)
    usual = healthy.outcomes(commanded)
    pose = healthy.settle(usual.base, usual.direction, healthy.none_held)
    was = (np.arange(4), [0, 1, 0, 0])  # the second command is lost
    seen = seen_at(commanded, twin.path(pose[0][was]))
    found = healthy.outcomes_as_seen(seen)
    initial, target = commanded.initial[0, 1], commanded.target[0, :, 1]
    stood = np.array([initial, target[0], target[0], target[2]])
    np.testing.assert_array_equal(found.direction[0, :, 0, 1], np.sign(target - stood))
    others = [0, 2, 3]
    np.testing.assert_array_equal(found.direction[..., others], usual.direction[..., others])


def test_a_motor_that_misses_its_command_keeps_its_angle(twin, measured_armpi):
    """Also what it had settled off its target: by Gauss, of a movement that is surely healthy."""
    commanded = movements([False] * 3)
    losses = (LostCommand(("motor_2",), 0.1, 0.1),)
    healthy = HealthyModel(twin, replace(measured_armpi, lost_commands=losses))
    usual = healthy.outcomes(commanded)
    pose = healthy.settle(usual.base, usual.direction, healthy.none_held)[0, :, 0]
    off = np.array([0.3, -1.0, 0.5, 0.2]) * healthy.scatter
    seen = seen_at(commanded, twin.path(pose + off))
    found = healthy.outcomes_as_seen(seen)

    _, jacobian = twin.path_and_jacobian(pose)
    spread = healthy.scatter**2
    for m in (1, 2):
        J, r = jacobian[m - 1], seen.point[0, m - 1] - twin.path(pose[m - 1])
        cov = J @ np.diag(spread) @ J.T + healthy.path_noise**2 * np.eye(3)
        expected = spread * (J.T @ np.linalg.solve(cov, r))
        kept = found.base[0, m, 1] - usual.base[0, m, 1]
        np.testing.assert_allclose(kept[1], expected[1], rtol=1e-3)
        np.testing.assert_array_equal(found.base[0, m, 0], commanded.target[0, m])


def seen_at(commanded, point):
    """Return the evidence of tools that settle at some points, (movement, 3) [m]."""
    count = len(point)
    seen = SettledEvidence.empty(run=1, movement=count, motor=4, axis=3)
    return replace(
        seen, movements=commanded, point=point[None], usable=np.ones((1, count), dtype=bool)
    )
