"""A robot that never rests, followed run by run; judged by an arm whose lag is known exactly."""

import copy

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from failuretwin.connection.tracked_diagnosis import History, begin, diagnose_tracked
from failuretwin.core.runs import RunTable, concatenate
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.robot import load_robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.diagnoser import BayesDiagnoser

ROBOT = load_robot("armpi_fpv")
STEP_S, LAG_S = 0.01, 0.16
HYPOTHESES = ["healthy", "motor_2:stuck", "motor_2:steady_state_error"]


def curve(seed, held=None):
    """A smooth motion that the arm follows exactly, 0.16 s later; motor 2 may be held."""
    rng = np.random.default_rng(seed)
    time = STEP_S * np.arange(801)
    at = np.arange(0.0, 9.0, 0.9)
    command = CubicSpline(at, rng.uniform(-0.7, 0.7, (len(at), 4)))(time)
    seen = np.stack([np.interp(time - LAG_S, time, one) for one in command.T], axis=-1)
    if held is not None:
        seen[:, 1] = held
    measured = np.full((len(time), 3), np.nan)
    measured[::10] = DigitalTwin(ROBOT).path(seen[::10])
    table = RunTable(
        run=[f"curve {seed}"],
        motor=ROBOT.motor_names,
        time=time,
        command=command[None],
        measured=measured[None],
        measured_rate_hz=10.0,
        attributes={"robot": ROBOT.name},
    )
    return table.to_dataset()


@pytest.fixture(scope="module")
def diagnoser():
    return BayesDiagnoser(ROBOT, "generic", HYPOTHESES)


def followed(life, runs, diagnoser):
    return diagnose_tracked(runs, diagnoser, History(copy.deepcopy(life), True))


@pytest.fixture(scope="module")
def tracked(diagnoser):
    runs = concatenate([curve(seed) for seed in range(4)])
    return followed(begin(diagnoser, True), runs, diagnoser)


def test_the_lag_is_learned_and_is_no_fault(tracked):
    life = tracked.life
    (mean,), (covariance,) = life.belief.moments
    lags = life.layout.lags
    found = life.lag_s + (mean * life.unit)[lags]
    deviation = np.sqrt(np.diag(covariance))[lags] * life.unit[lags]
    assert (np.abs(found - LAG_S) < 3.0 * deviation + 0.004).all()
    assert (deviation < 0.5 * life.unit[lags]).all()
    assert all(d.diagnosis == "healthy" for d in tracked.diagnoses)
    assert "readings on the way" in tracked.diagnoses[-1].method


def test_a_held_motor_is_named_by_what_came_before(tracked, diagnoser):
    (found,) = followed(tracked.life, curve(9, held=0.3), diagnoser).diagnoses
    assert found.posterior["motor_2:stuck"] > 0.99
    assert found.magnitude == pytest.approx(0.3, abs=0.02)


def test_a_life_goes_on_from_its_arrays(tracked, diagnoser):
    resumed = begin(diagnoser, True).resumed(tracked.life.to_arrays())
    assert resumed.lag_s == tracked.life.lag_s
    one, other = (followed(life, curve(9), diagnoser) for life in (tracked.life, resumed))
    assert one.diagnoses == other.diagnoses


def test_a_robot_may_rest_first_and_never_later(diagnoser):
    """What it has taught at rest stays: theta only gains places for lags."""
    known = generic_imperfections(ROBOT)
    rests = simulate(Plan(ROBOT, ["healthy"], runs_per_class=2, seed=5, imperfections=known))
    life = followed(begin(diagnoser, True), rests, diagnoser).life
    before, size = life.belief.moments, len(life.unit)
    life.see_moving(0.1)
    mean, covariance = life.belief.moments
    np.testing.assert_allclose(mean[0, :size], before[0][0], atol=1e-9)
    np.testing.assert_allclose(covariance[0, :size, :size], before[1][0], atol=1e-9)
    assert not covariance[0, :size, size:].any()
    found = followed(life, concatenate([curve(1), curve(2)]), diagnoser)
    assert found.life.arrived == rests.sizes["run"] + 2
    assert all("rest" not in (d.undecided or "") for d in found.diagnoses)
