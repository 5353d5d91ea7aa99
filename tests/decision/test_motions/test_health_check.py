from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import failuretwin as ft
from failuretwin.connection.emulated_arm import EmulatedArm, Emulation
from failuretwin.connection.links.base import Order
from failuretwin.core.hypothesis import HEALTHY, Hypothesis, paper_hypotheses
from failuretwin.data_knowledge.store import save_run_set
from failuretwin.decision.acting.belief import Judge, settled_evidence_of
from failuretwin.decision.acting.believed_arm import Seen
from failuretwin.decision.test_motions.design import next_movement
from failuretwin.decision.test_motions.health_check import (
    LOOSE_RAD,
    Checking,
    CheckResult,
    checking,
    faults_at_rest,
    motor_offsets,
)
from failuretwin.decision.test_motions.motions import Motions, read_motions, write_motions
from failuretwin.digital_model.calibrated_robot import calibrated, load_calibration
from failuretwin.digital_model.robot import load_robot
from failuretwin.failure_behavior.injection import ScheduledFault
from failuretwin.failure_behavior.modes import SteadyStateError
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.engine.registration import run_posterior, sensor_in_doubt
from failuretwin.inference.faults.prior_odds import log_prior
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from little_logs import exact_run

COUNT_RAD = np.deg2rad(0.24)


def judged(likelihood, hypotheses, priors):
    """Return the posterior of runs, with what is doubted of the arm integrated out."""
    in_doubt = sensor_in_doubt(likelihood, hypotheses, priors)
    return run_posterior(likelihood, hypotheses, priors, in_doubt)


def seen_of(model, designed, off=0.0, play=0.0, noise=None, held=None):
    """Return movements as seen if motors are off by (motor,) [rad], and have play (motor,).

    Args:
        model: The healthy robot.
        designed: The movements.
        off: Displacement of each motor [rad].
        play: Play of each motor [rad].
        noise: Scatter of each movement, (movement, motor) [rad].
        held: Motors that stay where they are in a movement, (movement, motor).
    """
    window, time, pose = [], 0.0, designed[0].previous
    for i, movement in enumerate(designed):
        direction, stood = np.sign(movement.order.target - movement.previous), pose
        pose = model.settle(movement.order.target, direction, model.none_held) + off
        pose = pose - 0.5 * play * direction + (0.0 if noise is None else noise[i])
        pose = pose if held is None else np.where(held[i], stood, pose)
        told = (movement.order.target, movement.previous, movement.order.duration)
        end = time + movement.seconds
        window.append(Seen(*told, time, end - 0.1, model.twin.path(pose)))
        time = end
    return window


def offsets_of(model, window):
    likelihood = RunLikelihood(settled_evidence_of([window]), model)
    hypotheses = paper_hypotheses(model.motor_names)
    return motor_offsets(likelihood, hypotheses, checking(model, hypotheses))


def scattered(model, designed, rng):
    """Return scatter as the model states it: Student t, the tail common to all motors."""
    dof = model.settling.tail_dof
    tail = np.sqrt(dof / rng.chisquare(dof, (len(designed), 1)))
    return model.without_doubt.scatter * tail * rng.standard_normal((len(designed), 4))


def deviations(found, off, play):
    """Return how many standard deviations zeros and plays are from the truth, (2, motor)."""
    return np.abs([(found.zero - off) / found.zero_sd, (found.play - play) / found.play_sd])


def test_zeros_and_play_are_found_from_both_sides(model, designed):
    off, play = np.deg2rad([0.5, -0.4, 0.0, 0.6]), np.deg2rad([0.0, 1.0, 0.5, 0.0])
    found = offsets_of(model, seen_of(model, designed, off, play))
    np.testing.assert_allclose(found.zero, off, atol=np.deg2rad(0.08))
    np.testing.assert_allclose(found.play, play, atol=np.deg2rad(0.08))


def test_intervals_of_zeros_and_play_contain_the_truth(model, designed):
    rng, away = np.random.default_rng(0), []
    for _ in range(10):
        off, play = 0.01 * rng.standard_normal((2, 4))
        noise = scattered(model, designed, rng)
        found = offsets_of(model, seen_of(model, designed, off, play, noise))
        away.append(deviations(found, off, play))
    assert np.max(away) < 4.0
    share_error = np.sqrt(0.9 * 0.1 / np.size(away))
    assert abs(np.mean(np.array(away) < 1.645) - 0.9) < 3.0 * share_error


@pytest.mark.parametrize("motor", [0, 2])
def test_a_lost_command_does_not_spoil_zeros_and_play(model, designed, motor):
    """A motor that stayed behind once is no zero and no play, of it or of the others."""
    rng, off = np.random.default_rng(motor), np.deg2rad([0.5, -0.4, 0.3, 0.6])
    travel = [abs(each.order.target - each.previous)[motor] for each in designed]
    lost = np.zeros((len(designed), 4), dtype=bool)
    lost[1 + np.argmax(travel[1:]), motor] = True
    noise = scattered(model, designed, rng)
    found = offsets_of(model, seen_of(model, designed, off, 0.0, noise, lost))
    whole = offsets_of(model, seen_of(model, designed, off, 0.0, noise))
    assert deviations(found, off, 0.0).max() < 4.0
    assert np.all(found.zero_sd < 1.5 * whole.zero_sd)


@pytest.mark.parametrize("motor", [0, 2])
def test_a_stuck_motor_tells_no_zero_of_its_own_and_spoils_no_other(model, designed, motor):
    rng, off = np.random.default_rng(motor), np.deg2rad([0.5, -0.4, 0.3, 0.6])
    stuck = np.tile(np.arange(4) == motor, (len(designed), 1))
    noise = scattered(model, designed, rng)
    found = offsets_of(model, seen_of(model, designed, off, 0.0, noise, stuck))
    assert found.zero_sd[motor] > 0.8 * LOOSE_RAD
    assert found.play_sd[motor] > 0.8 * LOOSE_RAD
    others = np.arange(4) != motor
    assert deviations(found, off, 0.0)[:, others].max() < 4.0
    assert np.all(found.zero_sd[others] < 0.6 * LOOSE_RAD)


def test_a_check_begins_with_two_to_one_that_all_is_well(model):
    hypotheses = faults_at_rest(model)
    prior = np.exp(log_prior(hypotheses, checking(model, hypotheses)))
    assert prior[hypotheses.index(HEALTHY)] == pytest.approx(2.0 / 3.0)
    assert {h.faults[0].mode for h in hypotheses if h.faults} == {
        "stuck", "steady_state_error", "backlash", "torque_loss", "encoder_bias", "encoder_scale",
    }  # fmt: skip


def test_a_motor_that_carries_nothing_is_not_asked_for_its_strength(model):
    asked = [str(hypothesis) for hypothesis in faults_at_rest(model)]
    assert model.settling.compliance[0] == 0.0
    assert "motor_1:torque_loss" not in asked
    assert "motor_2:torque_loss" in asked
    acted_on = [str(hypothesis) for hypothesis in Judge(model).hypotheses]
    assert "motor_1:torque_loss" not in acted_on
    assert "motor_2:torque_loss" in acted_on


def carried_out(known, gate, designed, schedule, modes=None, further=0):
    emulation = Emulation(known.robot, known.imperfections, schedule, 3, modes or {})
    motions = Motions.of(known.robot, designed)
    with EmulatedArm(emulation) as arm:
        return Checking(known, gate).carry_out(motions, further, arm, lambda _: None)


def test_an_arm_without_a_fault_is_green(known, gate, designed):
    """And nothing is left for the further movements that it may make."""
    pytest.importorskip("mujoco")
    result = carried_out(known, gate, designed, (), further=3)
    assert (result.light, result.motor, result.further) == ("green", "", 0)
    assert result.diagnosis.quality == ()
    assert result.movements == len(designed)
    assert sum(result.by_motor.values()) < 0.05


def test_what_is_named_is_the_motor_whatever_its_mode(model, designed):
    """Two modes that share the probability are one motor."""
    diagnosis = ft.Diagnosis(
        "check", {"healthy": 0.02, "motor_2:encoder_bias": 0.5, "motor_2:steady_state_error": 0.48}
    )
    offsets = offsets_of(model, seen_of(model, designed))
    assert CheckResult(diagnosis, offsets, 5).motor == "motor_2"
    assert CheckResult(diagnosis, offsets, 5).light == "red"
    open_one = ft.Diagnosis("check", {"healthy": 0.3, "motor_2:stuck": 0.4, "motor_3:stuck": 0.3})
    assert CheckResult(open_one, offsets, 5).light == "open"


def test_small_errors_of_each_motor_are_named(known, model, designed):
    """Errors of five counts, signs at random, on a scatter like the arm's own."""
    hypotheses = faults_at_rest(model)
    rng = np.random.default_rng(5)
    windows, size = [], 5.0 * COUNT_RAD
    for motor in range(4):
        noise = 0.8 * model.scatter * rng.standard_normal((len(designed), 4))
        noise[:, motor] += size * rng.choice([-1.0, 1.0], len(designed))
        windows.append(seen_of(model, designed, noise=noise))
    likelihood = RunLikelihood(settled_evidence_of(windows), model)
    found = judged(likelihood, hypotheses, checking(model, hypotheses))
    best = [str(hypotheses[i]) for i in np.argmax(found.log_posterior, axis=1)]
    assert [name.split(":")[0] for name in best] == model.motor_names


def test_the_next_movement_settles_what_is_open(model, gate, designed):
    """Whether motor 3 or 4 is off: the movement chosen tells more of it than usual ones do."""
    nine = paper_hypotheses(model.motor_names)
    rng = np.random.default_rng(2)
    noise = np.zeros((2, 4))
    noise[:, 3] = 6.0 * COUNT_RAD
    seen = seen_of(model, designed[:2], noise=noise)
    likelihood = RunLikelihood(settled_evidence_of([seen]), model)
    posterior = judged(likelihood, nine, checking(model, nine))
    at = designed[1].order.target
    order = next_movement(model, gate, posterior, at)
    assert isinstance(order, Order)
    assert not gate.wrong(order, [(at, order.target)])
    same = next_movement(model, gate, posterior, at)
    np.testing.assert_array_equal(order.target, same.target)
    assert np.any(np.abs(order.target - rng.uniform(-0.5, 0.5, 4)) > 0.01)
    sure = judged(likelihood, [HEALTHY], checking(model, [HEALTHY]))
    assert next_movement(model, gate, sure, at) is None


def test_further_movements_are_made_while_it_is_open(known, gate, designed):
    pytest.importorskip("mujoco")
    fault = ScheduledFault(Hypothesis.parse("motor_4:steady_state_error").faults[0], 0.0)
    modes = dict(MODES) | {"steady_state_error": SteadyStateError(magnitude=(0.025, 0.025))}
    emulation = (known, gate, designed[:3], (fault,), modes)
    result = carried_out(*emulation, further=2)
    assert result.further == result.movements - 3
    assert 1 <= result.further <= 2
    assert result.light != "open" or result.further == 2


@pytest.mark.parametrize("suffix", [".json", ".csv", ".mcap"])
def test_motions_are_written(armpi, designed, tmp_path, suffix):
    if suffix == ".mcap":
        pytest.importorskip("mcap")
    motions, path = Motions.of(armpi, designed), tmp_path / f"motions{suffix}"
    write_motions(motions, armpi, path)
    if suffix == ".json":
        again = read_motions(path, armpi)
        np.testing.assert_array_equal(again.target, motions.target)
        np.testing.assert_array_equal(again.seconds, motions.seconds)
    elif suffix == ".csv":
        again = read_motions(path, armpi)
        np.testing.assert_allclose(again.target, motions.target, atol=1e-6)
        np.testing.assert_allclose(again.start, motions.start, atol=1e-6)
        np.testing.assert_allclose(again.ramp_s, motions.ramp_s, atol=2e-3)
        np.testing.assert_allclose(again.seconds, motions.seconds, atol=2e-3)
        table = np.genfromtxt(path, delimiter=",", names=True)
        time, command = motions.reference()
        drawn = np.interp(time, table["time_s"], table["motor_3_rad"])
        np.testing.assert_allclose(drawn, command[:, 2], atol=0.02)
    else:
        assert path.read_bytes().startswith(b"\x89MCAP0")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nonsense", "cannot be read as motions"),
        ("{}", "holds no motions"),
        ('{"robot": "x", "motors": ["a"], "start_rad": [0], "target_rad": [[0]], "ramp_s": [1], '
         '"seconds": [1]}', "has motions of the motors a"),
    ],
)  # fmt: skip
def test_files_that_hold_no_motions_of_this_arm(armpi, tmp_path, text, said):
    path = tmp_path / "motions.json"
    path.write_text(text)
    with pytest.raises(ft.InputError, match=said):
        read_motions(path, armpi)


def test_ramps_that_make_no_sense(armpi, designed, tmp_path):
    record = Motions.of(armpi, designed).record()
    path = tmp_path / "motions.json"
    path.write_text(json.dumps({**record, "ramp_s": [-1.0] * len(designed)}))
    with pytest.raises(ft.InputError, match="each time as long as its ramp"):
        read_motions(path, armpi)
    with pytest.raises(ft.InputError, match=r"expected \.json, "):
        write_motions(Motions.of(armpi, designed), armpi, tmp_path / "motions.txt")


def test_a_bag_of_ros_1_holds_what_motors_are_told(armpi, designed, tmp_path):
    rosbags = pytest.importorskip("rosbags.rosbag1")
    typesys = pytest.importorskip("rosbags.typesys")
    motions, path = Motions.of(armpi, designed), tmp_path / "motions.bag"
    write_motions(motions, armpi, path)
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    with rosbags.Reader(path) as bag:
        said = [(t, store.deserialize_ros1(data, c.msgtype)) for c, t, data in bag.messages()]
    np.testing.assert_allclose([1e-9 * t for t, _ in said], motions.start_s, atol=1e-6)
    np.testing.assert_allclose([m.points[-1].positions for _, m in said], motions.target)
    due = [m.points[-1].time_from_start for _, m in said]
    np.testing.assert_allclose([d.sec + 1e-9 * d.nanosec for d in due], motions.ramp_s, atol=1e-6)
    assert said[0][1].joint_names == [motor.joint for motor in armpi.motors]
    with pytest.raises(ft.InputError, match="exists already"):
        write_motions(motions, armpi, path)


def test_a_table_that_is_cut_off_or_leaps_holds_no_motions(armpi, designed, tmp_path):
    path = tmp_path / "motions.csv"
    write_motions(Motions.of(armpi, designed), armpi, path)
    rows = path.read_text().splitlines()
    for wrong in (rows[:-1], [*rows[:3], rows[4], rows[3], *rows[5:]], rows[:1]):
        path.write_text("\n".join(wrong) + "\n")
        with pytest.raises(ft.InputError, match="holds no motions"):
            read_motions(path, armpi)


def test_errors_below_what_one_position_shows_are_weighed(model):
    """Where a profile states no least, a check of many movements begins a sixth of it."""
    known = load_calibration(None, "ur5e")
    arm = HealthyModel.of(known.twin, known.imperfections)
    told = checking(arm, faults_at_rest(arm)).error_ranges
    for motor, name in enumerate(arm.motor_names):
        low = min(begin for begin, _ in told[name])
        usual = Priors().sizes_of(MODES["steady_state_error"], arm, motor).ends[0]
        assert low == pytest.approx(usual / 6.25, rel=1e-6)
    assert min(low for low, _ in checking(model, faults_at_rest(model)).error_ranges) == (
        pytest.approx(2.0 * COUNT_RAD)
    )


def test_in_one_call(known):
    pytest.importorskip("mujoco")
    fault = Hypothesis.parse("motor_3:stuck")
    schedule = (ScheduledFault(fault.faults[0], 0.0),)
    with EmulatedArm(Emulation(known.robot, known.imperfections, schedule, 1)) as arm:
        found = ft.check(arm, seconds=8.0, tell=lambda _: None)
    assert (found.light, found.motor) == ("red", "motor_3")
    assert found.diagnosis.diagnosis == "motor_3:stuck"


def test_zeros_of_a_log_without_rests_are_true(gate, tmp_path, monkeypatch):
    robot, off = load_robot("armpi_fpv"), np.radians([1.5, 0.0, 0.0, 0.0])
    time, knots = 0.02 * np.arange(501), np.arange(0.0, 12.0, 0.9)
    told = CubicSpline(knots, np.random.default_rng(7).uniform(-0.7, 0.7, (len(knots), 4)))(time)
    save_run_set(exact_run(robot, told, told + off, 0.02), tmp_path / "log.nc")
    monkeypatch.setattr(Checking, "shown", lambda self, result, command, time: result)
    known = calibrated(robot, "generic")
    (found,) = Checking(known, gate).of_logs([tmp_path / "log.nc"])
    assert found.on_the_way
    away = (found.offsets.zero - off) / found.offsets.zero_sd
    assert np.abs(away).max() < 2.5
    assert np.degrees(found.offsets.zero_sd).max() < 3.0  # 5.7 before anything is seen
