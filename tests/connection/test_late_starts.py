from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from failuretwin import BayesDiagnoser
from failuretwin.core.hypothesis import HEALTHY, paper_hypotheses
from failuretwin.core.movements import Movements
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.disturbances import draw_disturbances
from failuretwin.digital_model.nonidealities import LostCommand, Timing
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.command_loss import LostCommands
from failuretwin.inference.observation.evidence import settled_evidence

RUNS = 60
MOTORS = ("motor_1", "motor_2", "motor_3", "motor_4")


@pytest.fixture(scope="module")
def known(armpi):
    return load_calibration("armpi_fpv", armpi).imperfections


def late_movements(imperfections, plan, run):
    """Return which movements of a simulated run started late, drawn again."""
    rng = np.random.default_rng([plan.seed, run])
    plan.movements.draw(plan.robot, imperfections.schedule, rng)
    count, duration = plan.movements.count, float(plan.time[-1])
    return draw_disturbances(imperfections, plan.robot, count, duration, rng).late > 0.0


@pytest.mark.parametrize("engine", ["servo", "physics"])
def test_late_starts_are_read_off_commands_and_readings(armpi, known, engine):
    """All of them, wherever a reading comes after the command."""
    if engine == "physics":
        pytest.importorskip("mujoco")
    plan = Plan(armpi, (HEALTHY,), RUNS, 12, known, engine=engine)
    evidence = settled_evidence(simulate(plan))
    found = LostCommands(armpi, known).late(evidence.movements, evidence.first_reading_delay)
    truth = np.array([late_movements(known, plan, run) for run in range(RUNS)])
    told = np.isfinite(evidence.first_reading_delay)
    there = evidence.movements.exists
    assert told.all(axis=1).sum() > 0.8 * RUNS
    np.testing.assert_array_equal(found[told & there], truth[told & there])
    assert truth[:, -1][told[:, -1]].any()


def one_movement():
    return Movements(
        np.zeros((1, 4)), np.ones((1, 1, 4)), np.full((1, 1, 4), 0.8), np.zeros((1, 1))
    )


@pytest.mark.parametrize(
    ("rate_hz", "first_reading_delay", "late"),
    [
        (10.0, 0.1, 0.0),
        (10.0, 1.0, 1.0),
        (10.0, np.nan, 0.25),
        (2.0, 0.45, 0.0),
        (2.0, 0.9, 0.25),  # half a second without a reading is usual then
        (2.0, 1.1, 1.0),
    ],
)
def test_silence_after_the_last_command_is_a_late_start(
    armpi, known, rate_hz, first_reading_delay, late
):
    slow = replace(
        known,
        timing=Timing(late_rate=0.25, late_s=(1.0, 1.5)),
        readings=replace(known.readings, rate_hz=rate_hz),
    )
    losses = LostCommands(armpi, slow)
    found = losses.late(one_movement(), np.array([[first_reading_delay]]))
    assert found.tolist() == [[late]]
    assert losses.late(one_movement()).tolist() == [[0.25]]


def test_lines_between_readings_tell_nothing_of_a_late_start(armpi, known):
    published = replace(known, readings=replace(known.readings, drawn_out=True))
    runs = simulate(Plan(armpi, (HEALTHY,), 3, 0, published))
    assert np.isnan(settled_evidence(runs).first_reading_delay).all()


def test_a_healthy_robot_that_loses_three_commands_in_a_row_is_healthy(armpi, known, twin, run_of):
    """Motor 1 stays where it went with the first movement, and goes on with the fifth."""
    lossy = replace(known, lost_commands=(LostCommand(("motor_1",), 0.1, 0.1),))
    targets = np.random.default_rng(5).uniform(-0.8, 0.8, (5, 4))
    stands = targets.copy()
    stands[1:4, 0] = stands[0, 0]
    diagnoser = BayesDiagnoser(twin, lossy)
    model = diagnoser.healthy_model
    pose = model.settle(stands, np.zeros_like(stands), model.none_held)
    runs = run_of(targets, twin.path(pose), MOTORS, rate=10.0)
    (found,) = diagnoser.diagnose(runs)
    assert found.diagnosis == "healthy"
    assert found.posterior["healthy"] > 0.5
    lost = [line for line in found.explanation if "did not get the command" in line]
    assert len(lost) == 3


def test_seen_losses_count_once(twin, armpi, known, run_of):
    """Of a motor that was seen to stay, it is no news that it had stayed.

    Two losses in a row cost the healthy robot no more than two that lie apart: the rates alone.
    """
    lossy = replace(known, lost_commands=(LostCommand(("motor_1",), 0.1, 0.1),))
    diagnoser = BayesDiagnoser(twin, lossy, hypotheses=(HEALTHY, *paper_hypotheses(MOTORS)[-1:]))
    targets = np.random.default_rng(6).uniform(-0.8, 0.8, (5, 4))

    def healthy(lost):
        model = diagnoser.healthy_model
        stands = targets.copy()
        for m in lost:
            stands[m, 0] = stands[m - 1, 0]
        pose = model.settle(stands, np.zeros_like(stands), model.none_held)
        evidence = settled_evidence(run_of(targets, twin.path(pose), MOTORS, rate=10.0))
        return RunLikelihood(evidence, model).log_healthy.sum()

    assert healthy((2, 3)) == pytest.approx(healthy((2, 4)), abs=1.0)
