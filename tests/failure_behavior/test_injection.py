from __future__ import annotations

import numpy as np
import pytest

from failuretwin.core.hypothesis import Fault, Hypothesis
from failuretwin.core.movements import Movements
from failuretwin.data_knowledge.generation import Plan, simulate_runs
from failuretwin.digital_model.imperfections import NO_IMPERFECTIONS, load_imperfections
from failuretwin.failure_behavior.injection import Injection
from failuretwin.failure_behavior.modes import MODES, FaultValue, SteadyStateError, Stuck

MOTORS = ("motor_1", "motor_2", "motor_3", "motor_4")
TIME = np.arange(300) * 0.01
ERROR = np.array([0.1, -0.2, 0.3])


@pytest.fixture
def movements():
    rng = np.random.default_rng(0)
    return Movements(
        initial=np.zeros((3, 4)),
        target=rng.uniform(-1, 1, (3, 3, 4)),
        ramp_duration=np.full((3, 3, 4), 0.6),
        start=np.tile([0.0, 1.0, 2.0], (3, 1)),
    )


@pytest.fixture
def position():
    return np.random.default_rng(1).normal(size=(3, 300, 4))


@pytest.fixture
def injection():
    """First run healthy, second with motor 3 stuck, third with errors of motor 2."""
    stuck = FaultValue(Fault("motor_3", "stuck"), 0.5, np.zeros(3), np.nan)
    error = FaultValue(Fault("motor_2", "steady_state_error"), 0.0, ERROR, 0.2)
    return Injection([(), (stuck,), (error,)], MOTORS, MODES)


def test_stuck_leaves_other_motors_and_earlier_times_as_they_are(injection, position):
    held = injection.on_angles(position, TIME)

    expected = position.copy()
    expected[1, 50:, 2] = position[1, 50, 2]
    np.testing.assert_array_equal(held, expected)


def test_error_is_added_to_the_targets_of_its_motor_alone(injection, movements):
    faulty = injection.on_targets(movements)

    expected = movements.target.copy()
    expected[2, :, 1] += ERROR
    np.testing.assert_array_equal(faulty.target, expected)
    for name in ("initial", "ramp_duration", "start"):
        np.testing.assert_array_equal(getattr(faulty, name), getattr(movements, name))


def test_nothing_given_is_changed(injection, movements, position):
    names = ("initial", "target", "ramp_duration", "start")
    before = [getattr(movements, name).copy() for name in names]
    angles = position.copy()

    injection.on_targets(movements)
    injection.on_angles(position, TIME)

    for name, values in zip(names, before, strict=True):
        np.testing.assert_array_equal(getattr(movements, name), values)
    np.testing.assert_array_equal(position, angles)


def test_magnitude_is_the_angle_held_or_the_size_of_the_error(injection, position):
    held = injection.on_angles(position, TIME)
    expected = [np.nan, position[1, 50, 2], 0.2]
    np.testing.assert_array_equal(injection.magnitudes(held), expected)


@pytest.mark.parametrize("imperfections", ["none", "armpi_fpv"])
@pytest.mark.parametrize("motor", range(1, 5))
def test_an_error_of_no_size_is_healthy_bit_for_bit(armpi, imperfections, motor):
    known = load_imperfections(imperfections, armpi)
    fault = Hypothesis((Fault(f"motor_{motor}", "steady_state_error"),))
    modes = {"steady_state_error": SteadyStateError((0.0, 0.0))}
    healthy = Plan(armpi, [Hypothesis()], 3, seed=7, imperfections=known)
    faulty = Plan(armpi, [fault], 3, seed=7, imperfections=known, modes=modes)

    without, withal = (simulate_runs(plan, range(3)) for plan in (healthy, faulty))

    for name in ("command", "measured", "position"):
        np.testing.assert_array_equal(getattr(withal, name), getattr(without, name))


def test_a_motor_stuck_at_the_end_of_the_run_is_healthy_bit_for_bit(armpi):
    fault = Hypothesis((Fault("motor_2", "stuck"),))
    late = {"stuck": Stuck((20.0, 20.0))}
    healthy = simulate_runs(Plan(armpi, [Hypothesis()], 2, seed=3), range(2))
    stuck = simulate_runs(Plan(armpi, [fault], 2, seed=3, modes=late), range(2))
    np.testing.assert_array_equal(stuck.measured, healthy.measured)


@pytest.mark.parametrize("imperfections", ["none", "armpi_fpv"])
def test_a_stuck_motor_stands_still_and_the_others_do_not_notice(armpi, imperfections):
    known = load_imperfections(imperfections, armpi)
    hypotheses = [Hypothesis((Fault("motor_1", "stuck"),))]
    stuck = simulate_runs(Plan(armpi, hypotheses, 3, seed=5, imperfections=known), range(3))
    healthy = simulate_runs(Plan(armpi, [Hypothesis()], 3, seed=5, imperfections=known), range(3))

    np.testing.assert_array_equal(stuck.command, healthy.command)
    np.testing.assert_array_equal(np.ptp(stuck.position[:, 49:, 0], axis=1), np.zeros(3))
    np.testing.assert_array_equal(stuck.position[:, 49, 0], stuck.truth.magnitude)
    # Motor 1 turns about the vertical, so it changes no load: the others move just the same.
    np.testing.assert_allclose(stuck.position[..., 1:], healthy.position[..., 1:], atol=1e-12)
    assert (np.abs(stuck.position[:, 300:, 0] - healthy.position[:, 300:, 0]) > 0.05).any()


def test_published_twin_and_faults_leave_the_command_alone(armpi):
    hypotheses = [Hypothesis(), Hypothesis((Fault("motor_4", "steady_state_error"),))]
    healthy, faulty = (Plan(armpi, [h], 2, imperfections=NO_IMPERFECTIONS) for h in hypotheses)
    runs = [simulate_runs(plan, range(2)) for plan in (healthy, faulty)]
    np.testing.assert_array_equal(runs[0].command, runs[1].command)
    assert (runs[0].measured != runs[1].measured).any()
