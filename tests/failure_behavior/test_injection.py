from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from failuretwin.core.hypothesis import Fault, Hypothesis
from failuretwin.core.movements import Movements
from failuretwin.data_knowledge.generate import Plan, simulate_runs
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS
from failuretwin.failure_behavior.fault import Course, FaultValue
from failuretwin.failure_behavior.injection import Injection
from failuretwin.failure_behavior.modes import SteadyStateError, Stuck
from failuretwin.failure_behavior.registry import MODES

MOTORS = ("motor_1", "motor_2", "motor_3", "motor_4")
TIME = np.arange(300) * 0.01
ERROR = np.array([0.1, -0.2, 0.3])


def fault(motor, mode, magnitude, onset=0.0, **per_movement):
    return FaultValue(Fault(motor, mode), magnitude, Course("step", onset), per_movement)


@pytest.fixture
def movements():
    rng = np.random.default_rng(0)
    return Movements(
        initial=np.zeros((4, 4)),
        target=rng.uniform(-1, 1, (4, 3, 4)),
        ramp_duration=np.full((4, 3, 4), 0.6),
        start=np.tile([0.0, 1.0, 2.0], (4, 1)),
    )


@pytest.fixture
def lost():
    lost = np.random.default_rng(2).random((4, 3, 4)) < 0.3
    lost[3, :, 0] = [False, True, False]  # a loss beside those of the faulty motor
    return lost


@pytest.fixture
def position():
    return np.random.default_rng(1).normal(size=(4, 300, 4))


@pytest.fixture
def injection():
    """First run healthy, then motor 3 stuck, errors of motor 2, and three faults at once."""
    faults = [
        (),
        (fault("motor_3", "stuck", np.nan, onset=0.5),),
        (fault("motor_2", "steady_state_error", np.nan, offset_rad=ERROR),),
        (
            fault("motor_1", "lost_commands", 0.5, chance=np.array([0.4, 0.6, 0.1])),
            fault("motor_2", "torque_loss", 0.25, onset=1.0),
            fault("motor_3", "encoder_bias", 0.2, onset=2.0),
        ),
    ]
    return Injection(faults, MOTORS, MODES)


def test_faults_of_movements_act_on_their_motors_alone(injection, movements, lost):
    faulty, gone = injection.on_movements(movements, lost)

    target, missing = movements.target.copy(), lost.copy()
    target[2, :, 1] += ERROR
    missing[3, [0, 2], 0] = True
    np.testing.assert_array_equal(faulty.target, target)
    np.testing.assert_array_equal(gone, missing)
    for name in ("initial", "ramp_duration", "start"):
        np.testing.assert_array_equal(getattr(faulty, name), getattr(movements, name))


def test_faults_of_the_reference_act_on_their_motors_alone(injection, position):
    expected = position.copy()
    expected[3, 200:, 2] += 0.2
    np.testing.assert_array_equal(injection.on_reference(position, TIME), expected)


def test_held_and_weak_are_the_faulty_motors_from_the_onset_on(injection):
    held, weak = np.zeros((4, 300, 4), dtype=bool), np.zeros((4, 300, 4))
    held[1, 50:, 2] = True
    weak[3, 100:, 1] = 0.25
    np.testing.assert_array_equal(injection.held(TIME), held)
    np.testing.assert_array_equal(injection.weakness(TIME), weak)


def test_where_nothing_acts_everything_stays_the_same_object(movements, lost, position):
    healthy = Injection([(), (), (), ()], MOTORS, MODES)
    still, gone = healthy.on_movements(movements, lost)
    assert still is movements
    assert gone is lost
    assert healthy.on_reference(position, TIME) is position
    assert healthy.held(TIME) is None
    assert healthy.weakness(TIME) is None


def test_nothing_given_is_changed(injection, movements, lost, position):
    given = [movements.target, movements.ramp_duration, lost, position]
    before = [values.copy() for values in given]

    injection.on_movements(movements, lost)
    injection.on_reference(position, TIME)

    for values, old in zip(given, before, strict=True):
        np.testing.assert_array_equal(values, old)


def test_what_only_the_motion_tells_joins_the_truth(injection, movements, position):
    healthy, stuck, error, several = injection.as_struck(position, TIME, movements.start)

    assert healthy == []
    assert stuck[0].magnitude == position[1, 50, 2]
    assert error[0].magnitude == pytest.approx(np.sqrt(np.mean(ERROR**2)))
    assert error[0].detail("rad")["offset_rad"] == ERROR.tolist()
    assert [value.magnitude for value in several] == [0.5, 0.25, 0.2]
    assert several[0].detail("ratio")["lost"] == [True, False, True]


@pytest.mark.parametrize("imperfections", ["none", "armpi_fpv"])
@pytest.mark.parametrize("motor", range(1, 5))
def test_an_error_of_no_size_is_healthy_bit_for_bit(armpi, imperfections, motor):
    known = load_calibration(imperfections, armpi).imperfections
    state = Hypothesis((Fault(f"motor_{motor}", "steady_state_error"),))
    modes = {"steady_state_error": SteadyStateError(magnitude=(0.0, 0.0))}
    healthy = Plan(armpi, [Hypothesis()], 3, seed=7, imperfections=known)
    faulty = Plan(armpi, [state], 3, seed=7, imperfections=known, modes=modes)

    without, withal = (simulate_runs(plan, range(3)) for plan in (healthy, faulty))

    for name in ("command", "measured", "position"):
        np.testing.assert_array_equal(getattr(withal, name), getattr(without, name))


def test_a_motor_stuck_at_the_end_of_the_run_is_healthy_bit_for_bit(armpi):
    state = Hypothesis((Fault("motor_2", "stuck"),))
    late = {"stuck": Stuck(onset_s=(20.0, 20.0))}
    healthy = simulate_runs(Plan(armpi, [Hypothesis()], 2, seed=3), range(2))
    stuck = simulate_runs(Plan(armpi, [state], 2, seed=3, modes=late), range(2))
    np.testing.assert_array_equal(stuck.measured, healthy.measured)


@pytest.mark.parametrize("imperfections", ["none", "armpi_fpv"])
def test_a_stuck_motor_stands_still_and_the_others_do_not_notice(armpi, imperfections):
    known = replace(load_calibration(imperfections, armpi).imperfections, readings=None)
    hypotheses = [Hypothesis((Fault("motor_1", "stuck"),))]
    stuck = simulate_runs(Plan(armpi, hypotheses, 3, seed=5, imperfections=known), range(3))
    healthy = simulate_runs(Plan(armpi, [Hypothesis()], 3, seed=5, imperfections=known), range(3))

    np.testing.assert_array_equal(stuck.command, healthy.command)
    held = stuck.position[:, 49:, 0]
    np.testing.assert_array_equal(np.nanmax(held, axis=1), np.nanmin(held, axis=1))
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
