"""The watch as a whole: calibrations that do not fit, learning, alarms that stand, limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from failuretwin import BayesDiagnoser
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import CLEAR, RAISED
from failuretwin.decision.streaming.alarm_rule import UNUSED, movements_to_tell
from failuretwin.decision.streaming.learning import RUN, LifeLearner, as_watched
from failuretwin.decision.streaming.monitor import FaultMonitor, monitor
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import LostCommand, Schedule, Timing
from failuretwin.inference.engine.theta import offsets_of
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.together.life_filter import LifeFilter

FEW = ["healthy", "motor_2:stuck", "motor_3:steady_state_error"]
"""Faults that are watched for where it does not matter which."""


def answers(watch, samples):
    return [watch.update(*sample) for sample in samples]


def test_a_fault_is_one_episode_from_its_alarm_to_its_repair(told_of_repaired):
    told = told_of_repaired
    onset, repaired = 0.3 + 2.04 * 6, 0.3 + 2.04 * 12
    states = [answer.alarm.state for answer in told]
    first, last = states.index(RAISED), len(states) - 1 - states[::-1].index(RAISED)
    assert onset < told[first].time < onset + 8.5
    assert repaired < told[last].time < repaired + 8.5
    assert set(states[first : last + 1]) == {RAISED}
    assert {answer.alarm.cause for answer in told[first : last + 1]} == {"motor_2:stuck"}
    episode = told[-1].alarm.episode
    assert (episode.number, episode.cause, told[-1].alarm.state) == (1, "motor_2:stuck", CLEAR)
    assert (episode.raised_s, episode.cleared_s) == (told[first].time, told[last + 1].time)


def test_a_larger_budget_alarms_no_later(twin, work):
    samples, raised = work(9, stuck=[(1, 4, 9)]), []
    for budget in (0.01, 100.0):
        watch = monitor(twin, "none", budget)
        told = (watch.update(*sample) for sample in samples)
        raised.append(next(a.time for a in told if a.alarm.state == RAISED))
    assert raised == sorted(raised, reverse=True)
    with pytest.raises(InputError, match="false alarms"):
        monitor(twin, "none", 0.0)


@pytest.fixture
def offset_work(twin, work, armpi):
    """Samples of a robot whose motors 2 and 4 always settle 1.2 deg off."""

    def samples(movements):
        off = np.deg2rad([0.0, 1.2, 0.0, -1.2])
        rows = work(movements)
        angles = [twin.path(reference + off) for _, reference, _ in rows]
        noise = np.random.default_rng(5).normal(0.0, 3e-4, (len(rows), 3))
        return [(t, c, p + n) for (t, c, _), p, n in zip(rows, angles, noise, strict=True)]

    return samples


def test_a_calibration_of_another_robot_is_no_fault(armpi, offset_work):
    """It does not add up: the robot is judged by what its kind does, and teaches the rest."""
    known = load_calibration(armpi.name, armpi)
    off = [f"motor_{k}:steady_state_error" for k in (2, 4)]
    hypotheses = ["healthy", *off]
    diagnoser = BayesDiagnoser(known.twin, known.imperfections, hypotheses, whole_run=False)
    watch = FaultMonitor(diagnoser)
    told = answers(watch, offset_work(20))
    assert RAISED not in {answer.alarm.state for answer in told}
    assert told[-1].alarm.state == CLEAR
    assert watch.fit.given == "armpi_fpv"
    assert watch.fit.fits < 0.01
    assert watch.fit.learned > 0


def test_a_calibration_that_fits_is_found_to(armpi, work):
    known = load_calibration("none", armpi)
    watch = monitor(known.twin, known.imperfections)
    answers(watch, work(8))
    assert (watch.fit.given, watch.fit.fits) == ("none", 1.0)


def movements_of(armpi, learner, offsets, scatter):
    """Settled points of a made-up robot, whose biases are those of each movement."""
    rng, motors, before = np.random.default_rng(0), 4, np.zeros(4)
    low, high = np.array([motor.movement_range for motor in armpi.motors]).T
    imperfections, given = learner.model.imperfections, learner.model.settling
    for m, bias in enumerate(offsets):
        theta = np.zeros(19)
        theta[7:11] = bias
        settling = offsets_of(theta, given)
        model = replace(
            learner.model, imperfections=replace(imperfections, settling=settling, variation=None)
        )
        target = rng.uniform(low, high, motors)
        pose = model.settle(target, np.sign(target - before), model.none_held)
        point = model.twin.path(pose + rng.normal(0.0, scatter, motors))
        one = SettledEvidence.empty(run=1, movement=1, motor=motors, axis=3)
        moves = one.movements
        moves.initial[0], moves.target[0, 0], moves.start[0, 0] = before, target, 2.0 * m
        moves.ramp_duration[:], one.point[0, 0], one.usable[:] = 0.8, point, True
        one.begin[:], one.end[:], one.first_reading_delay[:] = 2.0 * m + 1, 2.0 * m + 1.9, 0.05
        yield one
        before = target


def test_what_was_learned_is_what_the_robot_does(armpi):
    """Biases of a made-up robot from its settled points, movement by movement."""
    known = load_calibration("generic", armpi)
    diagnoser = BayesDiagnoser(known.twin, known.imperfections, FEW, whole_run=False)
    learner = LifeLearner(diagnoser)
    true, count = np.array([0.004, -0.009, 0.008, -0.006]), 41
    seen = list(movements_of(armpi, learner, np.tile(true, (count, 1)), 0.002))
    changed = [learner.take(one, learns=True) for one in seen]
    assert [m for m, new in enumerate(changed) if new] == list(range(2 * RUN - 1, count, RUN))
    learned = learner.model
    error = np.abs(np.asarray(learned.settling.bias) - true)
    assert (error < 4.0 * np.asarray(learned.imperfections.variation.bias) + 5e-4).all()
    assert error.max() < 0.004


def test_a_calibrated_robot_that_warms_up_is_followed(armpi):
    """Zeros drift by 1.5 scatters within 300 movements: faster than motors wear."""
    known = load_calibration(armpi.name, armpi)
    diagnoser = BayesDiagnoser(known.twin, known.imperfections, FEW, whole_run=False)
    learner = LifeLearner(diagnoser, cold=False)
    scatter = np.asarray(known.imperfections.settling.scatter)
    drift = 1.5 * scatter * np.linspace(0.0, 1.0, 300)[:, None]
    for one in movements_of(armpi, learner, drift, scatter):
        learner.take(one, learns=True)
    moved = np.asarray(learner.life.learned.settling.bias) - known.imperfections.settling.bias
    assert (np.abs(drift[-1] - moved) < scatter).all()


def test_one_motor_may_scatter_as_far_as_is_usual_of_the_kind(armpi, monkeypatch):
    """What a life fits to all motors together is the tail of several sums, nearer to a normal."""
    known = load_calibration("generic", armpi)
    learner = LifeLearner(BayesDiagnoser(known.twin, known.imperfections, whole_run=False))
    usual = learner.model.settling
    for together, alone in ((30.0, usual.tail_dof), (3.0, 3.0)):
        learned = replace(known.imperfections, settling=replace(usual, tail_dof=together))
        monkeypatch.setattr(LifeFilter, "learned", learned)
        assert as_watched(learner.life).settling.tail_dof == alone


def test_the_limit_of_lost_commands(armpi):
    """Closed form: nothing late, one loss in ten, a movement every 3.6 s: 100 000 in 100 hours."""
    generic = load_calibration("generic", armpi).imperfections
    lost = (LostCommand(("motor_1",), 0.06, 0.0), LostCommand(("motor_1", "motor_2"), 0.04, 0.0))
    known = replace(
        generic, lost_commands=lost, timing=Timing(), schedule=Schedule(period_s=(3.6, 3.6))
    )
    needed = np.log(1e5 / UNUSED)
    expected = {
        "motor_1": int(np.ceil(needed / -np.log(0.1))),
        "motor_2": int(np.ceil(needed / -np.log(0.04))),
    }
    assert movements_to_tell(known, armpi.motor_names, 1.0) == expected
    assert movements_to_tell(known, armpi.motor_names, 100.0)["motor_1"] == int(
        np.ceil(np.log(1e3 / UNUSED) / -np.log(0.1))
    )
