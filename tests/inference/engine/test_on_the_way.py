"""Runs that never rest: their moments in closed form, their evidence, and what is found of them."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import CubicSpline

import failuretwin as ft
from failuretwin.connection.calibration.calibrate import calibrate
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.movements import Stretches
from failuretwin.core.runs import concatenate, truth_of
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import Schedule, Variation
from failuretwin.digital_model.robot import load_robot
from failuretwin.digital_model.servo import first_order_lag
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.engine.moments import LATE_RATE, moments_of
from failuretwin.inference.engine.posterior import theta_posterior
from failuretwin.inference.engine.registration import robot_weighing
from failuretwin.inference.engine.rows import Scene
from failuretwin.inference.engine.theta import Layout
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.on_the_way import (
    BEND_S,
    SHARE,
    likeliest_lag,
    on_the_way,
)
from little_logs import exact_run

ROBOT = load_robot("armpi_fpv")
STEP_S = 0.01
WITHOUT_REST = RandomMovements(count=6, period_s=1.2, ramp_shares=(1.0,))
LONG = replace(WITHOUT_REST, count=8)


def late_run(command, late_s):
    """One run of an arm that follows its command (time, motor) exactly, so much later."""
    time = STEP_S * np.arange(len(command))
    seen = np.stack([np.interp(time - late_s, time, one) for one in command.T], axis=-1)
    return exact_run(ROBOT, command, seen)


def zigzag(seconds=6.0):
    """Ramps of 1.2 s from target to target, none with a rest."""
    time = STEP_S * np.arange(round(seconds / STEP_S) + 1)
    ends = np.arange(0.0, seconds + 1.2, 1.2)
    targets = np.random.default_rng(4).uniform(-0.7, 0.7, (len(ends), 4))
    targets[0] = 0.0
    return np.stack([np.interp(time, ends, one) for one in targets.T], axis=-1)


def curve(seconds=8.0):
    """A smooth curve through random points."""
    time = STEP_S * np.arange(round(seconds / STEP_S) + 1)
    at = np.arange(0.0, seconds + 1.0, 0.9)
    points = np.random.default_rng(7).uniform(-0.7, 0.7, (len(at), 4))
    return CubicSpline(at, points)(time)


def model():
    return HealthyModel.of(load_calibration("generic", ROBOT))


def moments(runs):
    """The run as the engine sees it."""
    healthy = model()
    evidence = Evidence(runs, healthy.settings, healthy.sensors).sound
    return healthy, on_the_way(evidence, healthy, healthy.lag_s)


def test_stretches_of_ramps_are_those_of_the_command():
    command, healthy = zigzag(), model()
    _, seen = moments(late_run(command, 0.0))
    stretches = seen.movements
    assert isinstance(stretches, Stretches)
    assert seen.usable.all()
    assert stretches.whole.all()
    time = STEP_S * np.arange(len(command))
    at = seen.begin[0] - healthy.lag_s
    wanted = np.stack([np.interp(at, time, one) for one in command.T], axis=-1)
    np.testing.assert_allclose(stretches.target[0], wanted, atol=1e-6)
    np.testing.assert_allclose(at - stretches.start[0], SHARE * 1.2, atol=0.06)
    begin = np.stack([np.interp(stretches.start[0], time, one) for one in command.T], axis=-1)
    np.testing.assert_allclose(stretches.origin()[0], begin, atol=1e-6)
    # the reading is late enough before the corner for the speed to be that of the ramp
    np.testing.assert_allclose(
        stretches.speed[0], (wanted - begin) / (at - stretches.start[0])[:, None], atol=1e-6
    )


def test_a_curve_is_read_on_its_way_also_where_the_tool_rests_behind_it():
    """Its last stretch, up to the rest, begins where the one before was read."""
    command = np.concatenate([curve(), np.repeat(curve()[-1:], 200, axis=0)])
    _, seen = moments(late_run(command, 0.0))
    stretches, time = seen.movements, STEP_S * np.arange(len(command))
    assert isinstance(stretches, Stretches)
    assert stretches.at_rest[0].tolist() == [False] * (len(stretches.at_rest[0]) - 1) + [True]
    assert len(stretches.at_rest[0]) > 6
    np.testing.assert_allclose(stretches.beginning[0, 1:], stretches.target[0, :-1], atol=1e-6)
    wanted = np.stack([np.interp(stretches.start[0], time, one) for one in command.T], axis=-1)
    np.testing.assert_allclose(stretches.beginning[0], wanted, atol=1e-6)
    np.testing.assert_allclose(stretches.target[0, -1], command[-1], atol=1e-6)


def test_a_motor_that_stops_on_a_curve_is_found_where_the_tool_rests_behind_it():
    command = np.concatenate([curve(), np.repeat(curve()[-1:], 200, axis=0)])
    stuck = command.copy()
    stuck[350:, 1] = stuck[350, 1]
    runs = late_run(command, 0.0)
    seen = np.full((len(command), 3), np.nan)
    seen[::10] = DigitalTwin(ROBOT).path(stuck[::10])
    (found,) = ft.diagnose(
        runs.assign(measured=(runs["measured"].dims, seen[None])), ROBOT, "generic"
    )
    assert str(found.diagnosis) == "motor_2:stuck"
    assert found.magnitude == pytest.approx(stuck[350, 1], abs=0.03)
    assert found.onset_90[0] <= 3.5 <= found.onset_90[1]


@pytest.mark.parametrize(("motor", "at"), [(0, 200), (2, 520)])
def test_a_motor_that_stops_on_a_curve_did_so_where_it_was_told_to_pass(motor, at):
    """The straight line between two moments is off that by up to half a second."""
    command = curve()
    stuck, runs = command.copy(), late_run(command, 0.0)
    stuck[at:, motor] = stuck[at, motor]
    seen = np.full((len(command), 3), np.nan)
    seen[::10] = DigitalTwin(ROBOT).path(stuck[::10])
    (found,) = ft.diagnose(
        runs.assign(measured=(runs["measured"].dims, seen[None])), ROBOT, "generic"
    )
    assert str(found.diagnosis) == f"motor_{motor + 1}:stuck"
    assert found.onset_90[0] <= STEP_S * at <= found.onset_90[1]
    assert found.onset_s == pytest.approx(STEP_S * at, abs=0.12)


@pytest.mark.parametrize(("motor", "error", "at"), [(0, 0.15, 310), (1, -0.2, 420)])
def test_an_error_that_comes_on_a_curve_and_stays_is_sized_and_dated(motor, error, at):
    """Taken for another zero of its motor, it would seem there from the start, at half its size."""
    command = curve()
    off, runs = command.copy(), late_run(command, 0.0)
    off[at:, motor] += error
    seen = np.full((len(command), 3), np.nan)
    seen[::10] = DigitalTwin(ROBOT).path(off[::10])
    (found,) = ft.diagnose(
        runs.assign(measured=(runs["measured"].dims, seen[None])), ROBOT, "generic"
    )
    assert str(found.diagnosis) == f"motor_{motor + 1}:steady_state_error"
    assert found.magnitude_90[0] <= abs(error) <= found.magnitude_90[1]
    assert found.magnitude == pytest.approx(abs(error), rel=0.1)
    assert found.onset_90[0] <= STEP_S * at <= found.onset_90[1]
    assert found.onset_90[1] - found.onset_90[0] < 1.2


@pytest.mark.parametrize(
    ("way", "motor", "error"), [(zigzag(), 1, 0.08), (curve(), 2, -0.1)], ids=["ramps", "curve"]
)
def test_an_error_that_is_there_all_along_is_found(way, motor, error):
    """It is no lag, and not drawn anew for each ramp: that would hardly ever be the same."""
    robot = load_robot("ur5e")
    middle = [np.mean(one.movement_range) for one in robot.motors]
    command = np.column_stack([way, way[:, 0] - way[:, 2]]) + middle
    runs = exact_run(robot, command, command + error * np.eye(5)[motor])
    name = robot.motor_names[motor]
    told = ["healthy", f"{name}:stuck", f"{name}:steady_state_error"]
    (found,) = ft.diagnose(runs, robot, hypotheses=told)
    assert str(found.diagnosis) == f"{name}:steady_state_error"
    assert found.probability > 0.85  # the rest is for a zero that is off
    assert found.magnitude == pytest.approx(abs(error), rel=0.15)
    assert found.onset_90[0] == 0.0
    healthy = HealthyModel.of(load_calibration("generic", robot))
    evidence = Evidence(runs, healthy.settings, healthy.sensors).sound
    assert likeliest_lag(evidence, healthy) == pytest.approx(0.0, abs=0.03)
    (zero,) = ft.diagnose(runs, robot, hypotheses=[*told, f"{name}:encoder_bias"])
    assert str(zero.diagnosis) == f"{name}:encoder_bias"  # whose error is always the same
    assert zero.probability > 0.85


@pytest.mark.parametrize("late_s", [0.2, 0.3])
def test_a_tool_that_still_arrives_behind_the_last_command_is_not_at_rest(late_s):
    """Clocks are apart: to take it for a rest would blame a motor of having stopped before."""
    command = np.concatenate([curve(), np.repeat(curve()[-1:], round(late_s / STEP_S), axis=0)])
    runs = late_run(command, late_s)
    healthy = model()
    evidence = Evidence(runs, healthy.settings, healthy.sensors).sound
    known = on_the_way(evidence, healthy, likeliest_lag(evidence, healthy))
    assert not (known.movements.at_rest[0] & known.usable[0]).any()
    (found,) = ft.diagnose(runs, ROBOT, "generic")
    assert str(found.diagnosis) == "healthy"
    assert found.probability > 0.8


def test_a_motor_that_follows_later_is_found_and_timed():
    command, time = curve(), STEP_S * np.arange(len(curve()))
    late = command.copy()
    late[:, 1] = np.interp(np.where(time < 3.5, time, time - 0.2), time, command[:, 1])
    runs, seen = late_run(command, 0.0), np.full((len(command), 3), np.nan)
    seen[::10] = DigitalTwin(ROBOT).path(late[::10])
    modes = ("stuck", "steady_state_error", "lag")
    hypotheses = ["healthy", *(f"motor_{k}:{mode}" for k in (1, 2) for mode in modes)]
    runs = runs.assign(measured=(runs["measured"].dims, seen[None]))
    (found,) = ft.diagnose(runs, ROBOT, "generic", hypotheses=hypotheses)
    assert str(found.diagnosis) == "motor_2:lag"
    assert found.magnitude == pytest.approx(0.2, abs=0.03)
    assert found.onset_90[0] <= 3.5 <= found.onset_90[1]
    more = [*hypotheses, "motor_2:intermittent", "motor_2:lost_commands"]
    (again,) = ft.diagnose(runs, ROBOT, "generic", hypotheses=more)
    assert str(again.diagnosis) == "motor_2:lag"  # not taken for one that sticks now and then
    (unasked,) = ft.diagnose(runs, ROBOT, "generic")
    assert unasked.undecided == "motor 2 late explains it better and is none of the hypotheses"
    assert "--hypotheses" in " ".join(unasked.explanation)


@pytest.mark.parametrize("stops", [((2.0, 3.5), (4.5, 6.0)), ((3.5, np.inf),)])
def test_a_motor_that_goes_on_again_is_not_said_to_be_stuck(stops):
    command, time = curve(), STEP_S * np.arange(len(curve()))
    way = command.copy()
    for begin, end in stops:
        way[(time >= begin) & (time < end), 0] = np.interp(begin, time, command[:, 0])
    runs, seen = late_run(command, 0.0), np.full((len(command), 3), np.nan)
    seen[::10] = DigitalTwin(ROBOT).path(way[::10])
    runs = runs.assign(measured=(runs["measured"].dims, seen[None]))
    (found,) = ft.diagnose(runs, ROBOT, "generic")
    if np.isfinite(stops[-1][1]):
        assert "motor 1 sticks now and then explains it better" in found.undecided
    else:
        assert str(found.diagnosis) == "motor_1:stuck"
        assert found.probability > 0.99


def test_a_motor_blamed_on_ramps_is_looked_at_beside_a_run_on_a_curve():
    """What shows on curves alone does not count for it."""
    ramps = zigzag(8.0)
    stuck = ramps.copy()
    stuck[350:, 1] = stuck[350, 1]
    some = [exact_run(ROBOT, ramps, stuck), late_run(curve(), 0.0)]
    some = [one.assign_coords(run=[name]) for one, name in zip(some, "ab", strict=True)]
    blamed, healthy = ft.diagnose(xr.concat(some, "run"), ROBOT, "generic")
    assert str(blamed.diagnosis) == "motor_2:stuck"
    assert str(healthy.diagnosis) == "healthy"


def test_movements_of_a_curve_do_not_speak_for_what_does_not_show_on_it():
    """A motor that loses commands misses no movement: a curve is one."""
    told = ["healthy", "motor_2:lost_commands"]
    (found,) = ft.diagnose(late_run(curve(), 0.0), ROBOT, "generic", hypotheses=told)
    assert found.evidence
    assert all(one.nats == 0.0 for one in found.evidence)


@pytest.mark.parametrize("sensing", ["encoders", "tool+encoders"])
def test_encoders_are_read_on_the_way(sensing):
    command, time = curve(), STEP_S * np.arange(len(curve()))
    stuck = command.copy()
    stuck[350:, 1] = stuck[350, 1]
    runs, seen = late_run(command, 0.0), np.full(command.shape, np.nan)
    seen[::10] = stuck[::10]
    tool = np.where(np.isfinite(seen[:, :1]), DigitalTwin(ROBOT).path(stuck), np.nan)
    runs = runs.assign(
        measured=(runs["measured"].dims, tool[None]),
        position=(("run", "time", "motor"), seen[None]),
    )
    (found,) = ft.BayesDiagnoser(ROBOT, "generic", sensing=sensing).diagnose(runs)
    assert str(found.diagnosis) == "motor_2:stuck"
    assert found.magnitude == pytest.approx(stuck[350, 1], abs=0.02)
    assert found.onset_90[0] <= time[350] <= found.onset_90[1]
    healthy = np.where(np.isfinite(seen), command, np.nan)
    tool = np.where(np.isfinite(seen[:, :1]), DigitalTwin(ROBOT).path(command), np.nan)
    (found,) = ft.BayesDiagnoser(ROBOT, "generic", sensing=sensing).diagnose(
        runs.assign(
            measured=(runs["measured"].dims, tool[None]),
            position=(("run", "time", "motor"), healthy[None]),
        )
    )
    assert str(found.diagnosis) == "healthy"


def test_a_motor_that_hardly_moves_is_named():
    command = curve()
    command[:, 2] = 0.3
    (found,) = ft.diagnose(late_run(command, 0.0), ROBOT, "generic")
    told = [line for line in found.explanation if " moved " in line]
    assert told == ["motor 3 moved 0 deg: if it is stuck, this hardly shows"]


def test_a_suspect_that_hardly_moves_is_named():
    command = curve()
    command[:, 2] = 0.3 + 0.05 * (command[:, 2] - command[:, 2].mean())
    off = command.copy()
    off[300:, 2] += 0.04
    run = late_run(command, 0.0)
    tool = DigitalTwin(ROBOT).path(off)[None]
    (found,) = ft.diagnose(run.assign(measured=(run["measured"].dims, tool)), ROBOT, "generic")
    told = [line for line in found.explanation if " moved " in line]
    assert told == ["motor 3 moved 3 deg: too little to tell what is wrong with it"], (
        found.posterior
    )


def test_points_of_an_arm_without_lag_are_those_of_the_command():
    healthy = model()
    for command in (zigzag(), curve()):
        _, seen = moments(late_run(command, healthy.lag_s))
        expected = healthy.sensors.expected(seen.movements.target[0])[0]
        rounded = 0.0015  # readings lie at the nearest time of the grid
        assert np.abs(seen.point[0] - expected)[seen.usable[0]].max() < rounded


def once_a_second(command):
    """The command as a log has it that states it once a second, joined by lines."""
    time = STEP_S * np.arange(len(command))
    at = time[::100]
    return np.stack([np.interp(time, at, one[::100]) for one in command.T], axis=-1)


def test_a_curve_that_is_told_once_a_second_cannot_be_judged_on_its_way():
    healthy = model()
    followed = late_run(curve(), healthy.lag_s)
    _, seen = moments(followed)
    assert seen.usable.any()
    told = once_a_second(curve())[None]
    _, seen = moments(followed.assign(command=(followed["command"].dims, told)))
    assert not seen.usable.any()


@pytest.mark.parametrize("fault", ["stuck", "off"])
def test_a_faulty_motor_on_straight_ramps_is_judged_on_its_way(fault):
    healthy, command = model(), zigzag()
    moved = command.copy()
    moved[:, 1] = command[150, 1] if fault == "stuck" else command[:, 1] + 0.1
    run = late_run(moved, healthy.lag_s)
    _, seen = moments(run.assign(command=(run["command"].dims, command[None])))
    assert seen.usable.all()


def test_a_curve_has_a_moment_every_second_and_loses_no_command():
    healthy, seen = moments(late_run(curve(), 0.0))
    assert seen.usable.sum() == 8
    assert not seen.movements.whole.any()
    found = moments_of(healthy.without_doubt, seen)
    assert not found.lost[np.isfinite(found.log_weight)].any()
    assert found.kept[0, 0] == 0.0
    assert (found.kept[0, 1:] == found.kept[0, 1]).all()
    assert 0.0 < found.kept[0, 1] < 1.0


def test_a_ramp_may_be_lost_or_not_have_begun():
    healthy, seen = moments(late_run(zigzag(), 0.0))
    found = moments_of(healthy.without_doubt, seen)
    waits = found.lost[0, 1].all(axis=-1) & np.isfinite(found.log_weight[0, 1])
    assert waits.sum() == 1
    share = np.exp(found.log_weight[0, 1] - np.logaddexp.reduce(found.log_weight[0, 1]))
    assert share[waits][0] == pytest.approx(LATE_RATE, rel=0.15)
    np.testing.assert_allclose(found.base[0, 1][waits][0], found.origin[0, 1])


@pytest.mark.parametrize("more_s", [-0.04, 0.0, 0.04])
def test_the_lag_is_found_and_is_no_fault(more_s):
    runs = late_run(curve(), model().lag_s + more_s)
    healthy, seen = moments(runs)
    weighing = robot_weighing(
        RunLikelihood(seen, healthy), paper_hypotheses(ROBOT.motor_names), ft.Priors()
    )
    mean, covariance = theta_posterior(weighing.evidence)
    lags = weighing.layout.lags
    deviation = np.sqrt(np.diag(covariance[0]))[lags]
    assert (np.abs(mean[0, lags] - more_s) < 2.5 * deviation).all()
    assert mean[0, lags].mean() == pytest.approx(more_s, abs=0.015)
    assert weighing.posterior().log_posterior[0].argmax() == 0


def followed(command, constant_s):
    """What a first-order lag makes of a command, exactly between samples."""
    kept, found = np.exp(-STEP_S / constant_s), [command[0]]
    for told in command[1:]:
        found.append(kept * found[-1] + (1.0 - kept) * told)
    return np.array(found)


def test_the_bend_of_a_first_order_lag_is_found():
    """x = q(t - T) + T^2 qdd / 2: all of a bend whose time constant is 0.05 s, not half of it."""
    command = curve()
    runs = late_run(followed(command, 0.05), 0.0).assign(
        command=(("run", "time", "motor"), command[None])
    )
    healthy = model()
    evidence = Evidence(runs, healthy.settings, healthy.sensors).sound
    seen = on_the_way(evidence, healthy, 0.05)
    pose = seen.movements.target[0] + seen.movements.bend[0]
    bent, straight = (
        np.abs(seen.point[0] - healthy.sensors.expected(q)[0])[seen.usable[0]]
        for q in (pose, seen.movements.target[0])
    )
    assert bent.max() < 0.0016  # as without a lag
    assert bent.mean() < 0.75 * straight.mean()
    weighing = robot_weighing(RunLikelihood(seen, healthy), [ft.Hypothesis(())], ft.Priors())
    mean, covariance = theta_posterior(weighing.evidence)
    at = weighing.layout.bend.start
    assert abs(mean[0, at] - 0.5) < 2.0 * np.sqrt(covariance[0, at, at])
    assert mean[0, at] > 0.0


def clipped():
    """A curve that stops dead where the range of a motor ends."""
    return np.clip(curve(), -0.6, 0.6)


@pytest.mark.parametrize("command", [curve(), clipped()], ids=["curve", "end"])
def test_a_bend_is_what_a_first_order_lag_makes_of_the_command(command):
    """Against its response step by step, also just behind a corner."""
    healthy = model()
    _, seen = moments(late_run(command, 0.0))
    fine = 1e-3
    time = np.arange(0.0, STEP_S * (len(command) - 1), fine)
    told = np.stack([np.interp(time, STEP_S * np.arange(len(command)), c) for c in command.T])
    followed = first_order_lag(told, told[:, 0], fine, BEND_S)
    at = seen.begin[0] - healthy.lag_s
    wanted = [
        np.interp(at + BEND_S, time, one) - np.interp(at, time, plain)
        for one, plain in zip(followed, told, strict=True)
    ]
    wanted = np.where(seen.movements.curved[0][:, None], np.transpose(wanted), np.nan)
    found = seen.movements.bend[0]
    known = np.isfinite(wanted) & seen.usable[0][:, None]
    assert known.any()
    np.testing.assert_allclose(found[known], wanted[known], atol=3e-3)


def test_a_robot_that_trails_is_expanded_about_its_lags():
    """Poses that follow the kinematics exactly, of which columns of theta are the first order."""
    healthy, seen = moments(late_run(curve(), 0.0))
    found, lag_s = moments_of(healthy, seen), np.array([0.0, 0.01, 0.02, 0.03])
    poses = [one.base[:, :, 0] for one in (found, found.trailing(lag_s))]
    np.testing.assert_allclose(poses[0] - poses[1], found.speed[:, :, 0] * lag_s, atol=1e-12)
    layout = Layout(4, geometry=False, moving=True)
    asked = Priors(), layout, np.eye(layout.size)
    scenes = [Scene.of(healthy.without_doubt, m, *asked) for m in (found, found.trailing(lag_s))]
    moved = scenes[0].healthy.residual[:, :, 0] - scenes[1].healthy.residual[:, :, 0]
    linear = scenes[0].columns[:, :, 0][..., layout.lags] @ lag_s
    usable = found.usable
    off = np.linalg.norm((moved - linear)[usable], axis=-1)
    size = np.linalg.norm(linear[usable], axis=-1)
    assert np.all(off < 0.05 * size.max())
    assert np.median(size) > 0.002


@pytest.mark.parametrize("late_s", [-0.4, -0.1, 0.0, 0.07, 0.3])
def test_clocks_that_are_apart_are_found(late_s):
    """Beside the mean lag; friction, which this arm has none of, is taken for 0.01 s of it."""
    healthy = model()
    late = healthy.lag_s + late_s
    command = curve()
    if late < 0.0:  # a clock that is ahead: the command is told later
        runs = late_run(command, 0.0)
        told = np.stack(
            [
                np.interp(
                    STEP_S * np.arange(len(command)) + late, STEP_S * np.arange(len(command)), q
                )
                for q in command.T
            ],
            axis=-1,
        )
        runs = runs.assign(command=(("run", "time", "motor"), told[None]))
    else:
        runs = late_run(command, late)
    evidence = Evidence(runs, healthy.settings, healthy.sensors).sound
    found = likeliest_lag(evidence, healthy) - healthy.lag_s
    assert found == pytest.approx(late_s, abs=0.016)


def test_friction_turns_over_within_twice_itself():
    """Not with the travel since the moment before: a curve turns between."""
    command = curve()
    healthy, seen = moments(late_run(command, 0.0))
    found = moments_of(healthy.without_doubt, seen)
    friction, time = np.array(healthy.settling.friction), STEP_S * np.arange(len(command))
    for m, at in enumerate(found.time[0] - healthy.lag_s):
        for motor, way in enumerate(command[time <= at + 1e-9].T):
            turned = np.flatnonzero(np.diff(np.sign(np.diff(way))))
            since = way[-1] - way[turned[-1] + 1] if len(turned) else way[-1] - way[0]
            expected = np.clip(abs(since) / friction[motor] - 1.0, -1.0, 1.0) * np.sign(since)
            assert found.direction[0, m, 0, motor] == pytest.approx(expected, abs=0.05)
    turning = np.sign(found.target[0] - found.origin[0]) != np.sign(found.direction[0, :, 0])
    assert turning.any()


@pytest.fixture(scope="module")
def never_at_rest():
    schedule = Schedule(period_s=(1.2, 1.2))
    usual = replace(generic_imperfections(ROBOT), schedule=schedule)
    return simulate(
        Plan(ROBOT, runs_per_class=3, seed=11, imperfections=usual, movements=WITHOUT_REST)
    )


def test_runs_without_a_rest_are_diagnosed(never_at_rest):
    found = ft.diagnose(never_at_rest, ROBOT, "generic")
    assert all("readings on the way" in d.method for d in found)
    right = np.array(
        [d.diagnosis == truth for d, truth in zip(found, truth_of(never_at_rest), strict=True)]
    )
    truth = np.array(truth_of(never_at_rest))
    assert right[[t.endswith("stuck") for t in truth]].sum() >= 11
    assert right.sum() >= 20  # of 27
    sure = np.array([max(d.posterior.values()) for d in found])
    assert not ((sure > 0.99) & ~right).any()
    assert not ((sure > 0.95) & ~right & (truth == "healthy")).any()


LABELS = ["fault", "fault_detail", "onset", "magnitude"]
BIAS = (0.025, -0.03, 0.02, -0.035)


def test_arms_that_never_rest_are_calibrated():
    """The zeros of the simulated robot lie in their intervals, and a stuck run teaches nothing."""
    usual = generic_imperfections(ROBOT)
    own = replace(usual.settling, bias=BIAS)
    known = replace(
        usual, settling=own, variation=Variation(), schedule=Schedule(period_s=(1.2, 1.2))
    )
    runs = simulate(
        Plan(ROBOT, ["healthy"], runs_per_class=4, seed=4, imperfections=known, movements=LONG)
    )
    stuck = simulate(Plan(ROBOT, ["motor_3:stuck"], 1, seed=4, imperfections=known, movements=LONG))
    found = calibrate(concatenate([runs, stuck]).drop_vars(LABELS), ROBOT, name="moving")
    assert found.imperfections.name == "moving"
    assert "never rests" in found.remarks[0]
    told = [p for p in found.parameters if p.name == "bias"]
    for parameter, truth in zip(told, BIAS, strict=True):
        assert parameter.low < truth < parameter.high
        assert parameter.high - parameter.low < 0.04  # before any run 0.07


def test_who_leaves_the_way_aside_cannot_tell(never_at_rest):
    some = never_at_rest.isel(run=slice(2))
    found = ft.BayesDiagnoser(ROBOT, "generic", whole_run=False).diagnose(some)
    assert max(max(d.posterior.values()) for d in found) < 0.9


def test_runs_that_rest_are_judged_as_without_those_that_do_not(never_at_rest):
    usual = generic_imperfections(ROBOT)
    rests = simulate(Plan(ROBOT, ["healthy", "motor_2:stuck"], 1, seed=3, imperfections=usual))
    alone = ft.diagnose(rests, ROBOT, "generic")
    both = ft.diagnose(concatenate([rests, never_at_rest.isel(run=slice(1))]), ROBOT, "generic")
    for one, other in zip(alone, both, strict=False):
        assert one.diagnosis == other.diagnosis
        assert one.probability == pytest.approx(other.probability, abs=1e-6)
