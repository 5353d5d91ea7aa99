"""Step tests of a robot: parameters of each motor, and the robot calibrated with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import stdtrit

from failuretwin.connection.calibration.parameters import LEARNED
from failuretwin.connection.calibration.result import Z_95, Calibration, LeftOut, Parameter
from failuretwin.connection.calibration.servo_loops import (
    PRIOR_DEVIATION,
    SharedFit,
    fit_shared,
    sizes_differ,
)
from failuretwin.core.errors import InputError
from failuretwin.core.foreign import files_below
from failuretwin.data_knowledge.readers.matlab import find_matlab_files
from failuretwin.data_knowledge.readers.raw_sessions import SESSION_FILES
from failuretwin.data_knowledge.step_tests import StepTest, find_step_tests, read_step_test
from failuretwin.digital_model.calibrated_robot import CalibratedLoop, with_loops
from failuretwin.digital_model.profile import Motor
from failuretwin.digital_model.robot import Robot

# Overshoot and settling time, read from the steps without a model.

BAND_SHARE, BAND_COUNTS = 0.02, 2.0
"""A motor has settled when it stays within 2 % of its travel, or within two counts if more."""


def overshoot(step: StepTest) -> float:
    """Return the largest excess over the settled level, as a share of the travel."""
    beyond = (step.position[step.time > 0.0] - step.settled) / step.travel
    return max(0.0, float(beyond.max()))


def settling_time(step: StepTest, rad_per_count: float) -> float:
    """Return the time from the end of the commanded ramp until the motor has settled [s]."""
    band = max(BAND_SHARE * abs(step.travel), BAND_COUNTS * rad_per_count)
    away = step.time[np.abs(step.position - step.settled) > 1.001 * band]
    return max(0.0, float(away[-1]) - step.duration) if len(away) else 0.0


def mean_interval(values: Sequence[float], blur: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean and the limits of its 95 % interval.

    `blur` is the standard deviation of each value by rounding.
    """
    mean, count = float(np.mean(values)), len(values)
    variance, factor = float(np.sum(np.square(blur))) / count**2, 1.96
    if count > 1:
        observed = float(np.var(values, ddof=1)) / count
        if observed > variance:
            variance, factor = observed, float(stdtrit(count - 1, 0.975))
    half = factor * float(np.sqrt(variance))
    return mean, mean - half, mean + half


# All parameters of each motor.

NAMES = ("loop gain P", "loop gain I", "filter time", "speed limit", "dead time")
UNITS = ("-", "1/s", "s", "rad/s", "s")
LIMITED = 5.0
"""A step of this many times speed limit / I runs at the limit for most of its way."""
COARSE = 0.05
"""Largest share of a count in the travel at which overshoot can be told from rounding."""


@dataclass(frozen=True)
class StepFit:
    """Parameters of one motor from its step tests.

    Attributes:
        motor: Its name.
        steps: Number of steps used.
        loop: Best values of loop and speed limit.
        parameters: All parameters with their 95 % intervals.
        residual: Root mean square residual of the readings [rad].
    """

    motor: str
    steps: int
    loop: CalibratedLoop
    parameters: tuple[Parameter, ...]
    residual: float


def fit_steps(
    steps: Sequence[StepTest], robot: Robot
) -> tuple[tuple[StepFit, ...], tuple[LeftOut, ...]]:
    """Fit every motor that has steps without flaw.

    Returns:
        The fits in chain order and the steps left out, each with its reason.
    """
    of_motor = {motor.name: [s for s in steps if s.motor == motor.name and not s.flaw]
                for motor in robot.motors}  # fmt: skip
    fits = tuple(
        _fit_motor(of_motor[motor.name], motor, robot)
        for motor in robot.motors
        if of_motor[motor.name]
    )
    flawed = (step for step in steps if step.flaw)
    return fits, tuple(LeftOut(s.source, s.number, s.motor, s.flaw) for s in flawed)


def _fit_motor(steps: list[StepTest], motor: Motor, robot: Robot) -> StepFit:
    quantum = robot.servo_units.rad_per_count
    fit = fit_shared(steps, motor, quantum)
    P, (I, tau, limit) = float(fit.mode[0]), np.exp(fit.mode[1:4]).tolist()  # noqa: E741
    return StepFit(
        motor=motor.name,
        steps=len(steps),
        loop=CalibratedLoop(motor.name, P, I, tau, limit),
        parameters=(
            *(_shared_parameter(k, fit, steps, motor.name) for k in range(len(NAMES))),
            _overshoot(steps, motor.name, quantum),
            _settling(steps, motor.name, quantum),
        ),
        residual=fit.residual,
    )


def _shared_parameter(k: int, fit: SharedFit, steps: list[StepTest], motor: str) -> Parameter:
    deviation = float(fit.deviation[k])
    if NAMES[k] == "speed limit" and not sizes_differ(steps):
        deviation = float(PRIOR_DEVIATION[k])
    limits = np.array([0.0, -Z_95, Z_95]) * deviation + fit.mode[k]
    if k in (1, 2, 3):
        limits = np.exp(limits)
    if NAMES[k] == "loop gain P":
        limits = np.maximum(limits, 0.0)
    learned = deviation < LEARNED * float(PRIOR_DEVIATION[k])
    note = "" if learned else _note(k, fit, steps)
    value, low, high = limits.tolist()
    return Parameter(NAMES[k], motor, UNITS[k], value, low, high, learned, note)


def _note(k: int, fit: SharedFit, steps: list[StepTest]) -> str:
    """Return why the steps do not determine a shared parameter, and which steps would."""
    gain, limit = np.exp(fit.mode[[1, 3]])
    largest = np.rad2deg(max(abs(step.travel) for step in steps))
    large = np.rad2deg(LIMITED * limit / gain)
    shortest = 1e3 * min(step.duration for step in steps)
    if NAMES[k] == "speed limit":
        return (
            f"no step reaches it, the largest is {largest:.0f} deg in {shortest:.0f} ms; needed is "
            f"one of {large:.0f} deg or more in 5 ms, and a small one"
        )
    period = 1e3 * float(np.median(np.diff(steps[0].time)))
    return (
        f"{len(steps)} steps read every {period:.0f} ms do not determine it; needed are more steps "
        f"of different sizes up to {np.rad2deg(limit / gain):.0f} deg in 5 ms, there and back, or "
        "faster reading"
    )


def _overshoot(steps: list[StepTest], motor: str, quantum: float) -> Parameter:
    blur = [quantum / abs(step.travel) for step in steps]
    mean, low, high = mean_interval([overshoot(step) for step in steps], blur)
    learned = min(blur) < COARSE
    note = "" if learned else "a count is a large share of such small steps; larger ones are needed"
    return Parameter("overshoot", motor, "share", mean, max(low, 0.0), high, learned, note)


def _settling(steps: list[StepTest], motor: str, quantum: float) -> Parameter:
    blur = [float(np.median(np.diff(step.time))) for step in steps]
    mean, low, high = mean_interval([settling_time(step, quantum) for step in steps], blur)
    return Parameter("settling time after the ramp", motor, "s", mean, max(low, 0.0), high)


# Step tests among the logs of a calibration.


@dataclass(frozen=True)
class LearnedLoops:
    """Servo loops of a robot from step tests.

    Attributes:
        robot: The robot with the fitted loops; unchanged unless every motor was tested.
        fits: Fit of each motor.
        left_out: Steps that were not used.
    """

    robot: Robot
    fits: tuple[StepFit, ...] = ()
    left_out: tuple[LeftOut, ...] = ()


def split_step_tests(logs: Sequence[Path], columns: Path | None) -> tuple[list[Path], list[Path]]:
    """Return step tests, as files, and all other logs; a folder with both kinds counts as both.

    Other CSV files in a folder are logs if there is a column map.

    Raises:
        InputError: If there are step tests only.
    """
    tests, others = list[Path](), list[Path]()
    for log in logs:
        found = find_step_tests(log)
        tests += found
        if not found or (log.is_dir() and _holds_more(log, found, columns)):
            others.append(log)
    if not others:
        raise InputError(
            f"{len(tests)} step tests and no other log. Step tests say how fast a motor follows, "
            "but each rests at two or three places only; where motors settle takes logs of the arm "
            "moving about. Give a session of the healthy robot in addition."
        )
    return list(dict.fromkeys(tests)), others


def _holds_more(folder: Path, tests: list[Path], columns: Path | None) -> bool:
    if any(True for name in SESSION_FILES for _ in files_below(folder, name)):
        return True
    if columns is not None and len(files_below(folder, "*.csv")) > len(tests):
        return True
    return bool(find_matlab_files(folder))


def learn_loops(tests: Sequence[Path], robot: Robot) -> LearnedLoops:
    """Fit servo loops to step tests.

    Raises:
        InputError: If a file cannot be read, or there are step tests but none can be used.
    """
    if not tests:
        return LearnedLoops(robot)
    steps = [step for test in tests for step in read_step_test(test, robot)]
    fits, left_out = fit_steps(steps, robot)
    if not fits:
        reasons = "; ".join(f"{out.run}: step {out.movement} {out.reason}" for out in left_out[:3])
        raise InputError(
            f"none of {len(steps)} steps can be used ({reasons}). Give step tests of a healthy "
            "motor in files named after its servo, such as test_motor_6.csv, or leave them out."
        )
    loops = [fit.loop for fit in fits] if len(fits) == len(robot.motors) else []
    return LearnedLoops(with_loops(robot, loops), fits, left_out)


def with_step_tests(found: Calibration, steps: LearnedLoops) -> Calibration:
    """Return a calibration with the parameters of step tests.

    The loops are used only if every motor has one: delay and lag are parameters of the whole robot
    in addition to the loops, and cannot be added to fitted and published loops at once.
    """
    if not steps.fits:
        return found
    counts = ", ".join(f"{fit.steps} of {fit.motor}" for fit in steps.fits)
    tested = [fit.motor for fit in steps.fits]
    missing = [name for name in steps.robot.motor_names if name not in tested]
    use = "delay, lag and ramp shortening are added to them"
    if missing:
        use = f"not used by the twin, since {', '.join(missing)} had no step test"
    return replace(
        found,
        parameters=(*found.parameters, *(p for fit in steps.fits for p in fit.parameters)),
        loops=() if missing else tuple(fit.loop for fit in steps.fits),
        left_out=(*found.left_out, *steps.left_out),
        remarks=(*found.remarks, f"servo loops from step tests ({counts}): {use}"),
    )
