"""Motors that follow another way than they are told: against the twin that makes such faults."""

from dataclasses import replace

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.movements import find_movements
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.robot import load_robot
from failuretwin.failure_behavior.registry import MODES as MODES_BY_NAME
from failuretwin.inference.engine.moments import moments_of
from failuretwin.inference.engine.way_rows import FollowedWay, Ramps
from failuretwin.inference.faults.prior_odds import prior_odds
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.on_the_way import on_the_way
from little_logs import exact_run

ROBOT = load_robot("armpi_fpv")
STEP_S = 0.01
MODES = ("stuck", "steady_state_error", "lag", "slow")
HYPOTHESES = ["healthy", *(f"motor_{k}:{mode}" for k in (1, 2, 3) for mode in MODES)]


def zigzag(ramp_s=1.2, count=7):
    """Ramps from target to target, none with a rest: times (time,) and commands (time, motor)."""
    ends = ramp_s * np.arange(count + 1)
    time = STEP_S * np.arange(round(ends[-1] / STEP_S) + 1)
    targets = np.random.default_rng(4).uniform(-0.7, 0.7, (len(ends), 4))
    return time, np.stack([np.interp(time, ends, one) for one in targets.T], axis=-1)


def slowed(time, command, motor, factor, onset):
    """The reference of a motor whose ramps take longer from an onset on, as the twin makes it."""
    movements = find_movements(command[None], time)
    ramp = movements.ramp_duration.copy()
    ramp[0, movements.start[0] > onset, motor] *= factor
    return replace(movements, ramp_duration=ramp).reference(time)[0]


@pytest.mark.parametrize("ramp_s", [1.2, 3.4])
@pytest.mark.parametrize(("factor", "first"), [(1.5, 0), (2.0, 2), (4.0, 1)])
def test_a_slow_motor_is_where_the_twin_moves_it(ramp_s, factor, first):
    """Also where a long ramp is read several times, and where it was cut off before."""
    time, command = zigzag(ramp_s)
    healthy = HealthyModel.of(load_calibration("generic", ROBOT))
    evidence = Evidence(exact_run(ROBOT, command, command), healthy.settings, healthy.sensors).sound
    moments = moments_of(healthy, on_the_way(evidence, healthy, healthy.lag_s))
    truth = slowed(time, command, 1, factor, first * ramp_s - 0.1)
    first = int(np.searchsorted(moments.time[0], first * ramp_s + healthy.lag_s))
    at = moments.time[0] - healthy.lag_s
    wanted = np.interp(at, time, truth[:, 1]) - np.interp(at, time, command[:, 1])
    ramps = Ramps.of(moments, 1, healthy.lag_s)
    off = ramps.off(np.full((1, 1, 1), factor), np.array([first]))[0, 0, :, 0]
    assert np.abs(wanted).max() > 0.1
    np.testing.assert_allclose(off, wanted, atol=2e-3)


@pytest.mark.parametrize(("motor", "factor", "onset"), [(1, 2.0, 3.0), (0, 3.0, -1.0)])
def test_a_slow_motor_is_found_and_sized(motor, factor, onset):
    time, command = zigzag()
    runs = exact_run(ROBOT, command, slowed(time, command, motor, factor, onset))
    (found,) = ft.diagnose(runs, ROBOT, "generic", hypotheses=HYPOTHESES)
    assert str(found.diagnosis) == f"motor_{motor + 1}:slow"
    assert found.magnitude == pytest.approx(1.0 - 1.0 / factor, abs=0.05)
    assert found.onset_90[0] <= max(onset, 0.0) <= found.onset_90[1]


def test_a_late_motor_is_not_taken_for_a_slow_one():
    time, command = zigzag()
    late = command.copy()
    late[:, 1] = np.interp(np.where(time < 3.5, time, time - 0.2), time, command[:, 1])
    (found,) = ft.diagnose(exact_run(ROBOT, command, late), ROBOT, "generic", hypotheses=HYPOTHESES)
    assert str(found.diagnosis) == "motor_2:lag"
    assert found.magnitude == pytest.approx(0.2, abs=0.03)


def test_a_healthy_arm_is_neither():
    _, command = zigzag()
    runs = exact_run(ROBOT, command, command)
    (found,) = ft.diagnose(runs, ROBOT, "generic", hypotheses=HYPOTHESES)
    transient = sum(p for h, p in found.posterior.items() if str(h).endswith(("lag", "slow")))
    assert str(found.diagnosis) == "healthy"
    assert transient < 0.1


# Along streamed curves.


def curve():
    """A smooth way without a stop: times (time,) and commands (time, motor)."""
    time = STEP_S * np.arange(901)
    phase = np.array([0.3, 1.1, 2.0, 2.9])
    wave = np.sin(1.9 * time[:, None] + phase) + 0.6 * np.sin(0.8 * time[:, None] + 2.0 * phase)
    return time, 0.55 * wave


def limited(command, most):
    """Where a motor gets that moves by so much a step at most."""
    found = command.copy()
    for k in range(1, len(found)):
        found[k] = found[k - 1] + np.clip(command[k] - found[k - 1], -most, most)
    return found


def with_play(command, play):
    """Where a joint stands that its motor drags through a play."""
    found = command.copy()
    for k in range(1, len(found)):
        found[k] = np.clip(found[k - 1], command[k] - 0.5 * play, command[k] + 0.5 * play)
    return found


def broken(command, motor, onset, made):
    """Commands of which one motor makes something else from a sample on."""
    found = command.copy()
    found[onset:, motor] = made(command[onset:, motor])
    return found


def largest_step(values):
    return np.abs(np.diff(values)).max()


CURVED = ["healthy", *(f"motor_{k}:{m}" for k in (1, 2, 3) for m in (*MODES, "backlash"))]


def test_a_motor_that_lost_speed_is_found_on_a_curve():
    _, command = curve()
    followed = broken(command, 1, 0, lambda way: limited(way, 0.5 * largest_step(way)))
    runs = exact_run(ROBOT, command, followed)
    (found,) = ft.diagnose(runs, ROBOT, "generic", hypotheses=CURVED)
    assert str(found.diagnosis) == "motor_2:slow"
    assert found.magnitude == pytest.approx(0.5, abs=0.08)


def test_a_joint_with_play_is_found_on_a_curve():
    _, command = curve()
    followed = broken(command, 1, 300, lambda way: with_play(way, 0.14))
    runs = exact_run(ROBOT, command, followed)
    (found,) = ft.diagnose(runs, ROBOT, "generic", hypotheses=CURVED)
    assert str(found.diagnosis) == "motor_2:backlash"
    assert found.magnitude == pytest.approx(0.14, abs=0.03)
    assert found.onset_90[0] - 0.1 <= 3.0 <= found.onset_90[1]  # it shows once it turns


def test_missed_movements_do_not_show_on_a_curve_which_is_one():
    _, command = curve()
    late = broken(command, 1, 20, lambda way: command[: len(way), 1])
    asked = ["healthy", "motor_2:lag", "motor_2:intermittent", "motor_2:lost_commands"]
    odds = [prior_odds(Hypothesis.parse(name)) for name in asked[2:]]
    for followed in (command, late):
        runs = exact_run(ROBOT, command, followed)
        (found,) = ft.diagnose(runs, ROBOT, "generic", hypotheses=asked)
        sound, _, sticks, missed = (found.posterior[name] for name in asked)
        assert missed / sound == pytest.approx(odds[1], rel=1e-6)
        assert followed is late or sticks / sound < 0.1 * odds[0]  # as nothing sticks


@pytest.mark.parametrize(
    ("mode", "size", "made"),
    [
        ("backlash", 0.1, lambda way: with_play(way, 0.1)),
        ("slow", 0.4, lambda way: limited(way, 0.6 * largest_step(curve()[1][:, 1]))),
        ("lag", 0.2, lambda way: np.concatenate([np.full(20, way[0]), way[:-20]])),
        ("encoder_scale", -0.2, lambda way: 0.8 * way),
    ],
)
def test_a_fault_changes_the_way_as_it_does_in_the_twin(mode, size, made):
    _, command = curve()
    healthy = HealthyModel.of(load_calibration("generic", ROBOT))
    evidence = Evidence(exact_run(ROBOT, command, command), healthy.settings, healthy.sensors).sound
    moments = moments_of(healthy, on_the_way(evidence, healthy, healthy.lag_s))
    sizes = np.sort([size, 0.5 * size, 1.5 * size])
    way = FollowedWay.of(moments, 1, MODES_BY_NAME[mode], sizes, np.array([0, 4]))
    off = way.at(np.full((1, 2, 1), size))[0, :, :, 0]
    at, step = np.rint((moments.time[0] - healthy.lag_s) / STEP_S).astype(int), 0.012
    for row, onset in enumerate((0, at[3])):
        followed = broken(command, 1, onset, made)
        wanted = (followed - command)[at, 1]
        assert np.abs(wanted).max() > 3.0 * step
        counts = np.arange(len(at)) >= (0, 5)[row]  # that at the onset itself is on its way
        np.testing.assert_allclose(off[row][counts], wanted[counts], atol=step)
