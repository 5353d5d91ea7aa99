"""Motors that are late or slow, seen on their way: against the twin that makes such faults."""

from dataclasses import replace

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.core.movements import find_movements
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.robot import load_robot
from failuretwin.inference.engine.moments import moments_of
from failuretwin.inference.engine.transient_rows import Ramps
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
