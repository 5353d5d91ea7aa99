"""Where the servo engine and the physics engine of the ArmPi FPV agree, in servo counts.

Both get the same random movements. The servo engine is the published loops plus the settled errors
fitted to healthy logs of the real robot; the physics engine has motors and gears of its own.
"""

from __future__ import annotations

import numpy as np

from failuretwin import DigitalTwin, load_robot
from failuretwin.core.movements import Movements, stack_movements
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.nonidealities import Schedule
from failuretwin.digital_model.physics.engine import PhysicsEngine
from failuretwin.digital_model.twin import Drive
from failuretwin.failure_behavior.random_movements import RandomMovements

RUNS = 300
TIME = as_floats(np.arange(1001) * 0.01)
FITTED = np.array(
    [[-0.35, 0.0, -1.54], [-1.22, -45.7, -1.01], [-0.05, 51.5, -2.49], [-0.65, -59.1, -2.64]]
)
"""Settled error of each motor [counts]: constant, by lever arm [counts/m], by direction of travel;
least squares on the healthy logs of robot b, 2024-10-03."""
LINKS_M = (0.10048, 0.094714, 0.05071)
RAMP_PART = (0.4, 0.9)
"""Part of a ramp over which its lag is taken."""
FAST_RAD_S = 0.5
"""Ramps slower than this tell little of the lag."""


def lever_arms(pose: FloatArray) -> FloatArray:
    """Return the horizontal lever arm of each motor, log's sense of angles, (..., motor) [m]."""
    _, q2, q3, q4 = np.moveaxis(pose, -1, 0)
    along = [q2, q2 - q3, q2 - q3 + q4]
    parts = [length * np.sin(angle) for length, angle in zip(LINKS_M, along, strict=True)]
    arms = [np.zeros_like(q2), parts[0] + parts[1] + parts[2], parts[1] + parts[2], parts[2]]
    return np.stack(arms, axis=-1)


def fit(error: FloatArray, arms: FloatArray, direction: FloatArray) -> FloatArray:
    """Return settled errors (..., motor) fitted by the terms of `FITTED`, (motor, 3)."""
    rows = []
    for k in range(error.shape[-1]):
        columns = [np.ones(error[..., k].size), arms[..., k].ravel(), direction[..., k].ravel()]
        terms = np.stack(columns, axis=1)
        rows.append(np.linalg.lstsq(terms, error[..., k].ravel(), rcond=None)[0])
    return np.array(rows)


def lag(movements: Movements, reference: FloatArray, angle: FloatArray, motor: int) -> float:
    """Return how far a motor runs behind its ramps [s], the median over all fast ones."""
    lags = []
    for run, movement in np.ndindex(movements.start.shape):
        start = movements.start[run, movement]
        ramp = movements.ramp_duration[run, movement, motor]
        first, last = (int((start + part * ramp) / 0.01) for part in RAMP_PART)
        asked = reference[run, first : last + 1, motor]
        speed = (asked[-1] - asked[0]) / (0.01 * (last - first))
        if abs(speed) > FAST_RAD_S:
            lags.append(np.mean(asked - angle[run, first : last + 1, motor]) / speed)
    return float(np.median(lags))


def overshoot(movements: Movements, angle: FloatArray) -> FloatArray:
    """Return how far motors swing past the angle they settle at, (run, movement, motor) [rad]."""
    travel = np.sign(np.diff(movements.target, axis=1, prepend=movements.initial[:, None]))
    whole = angle[:, 1:].reshape(len(angle), movements.start.shape[1], -1, angle.shape[-1])
    beyond = (whole - whole[:, :, -1:]) * travel[:, :, None]
    return np.maximum(beyond.max(axis=2), 0.0)


def main() -> None:
    """Measure and print one row for each motor."""
    robot = load_robot("armpi_fpv")
    draws = (np.random.default_rng([1, run]) for run in range(RUNS))
    schedule = Schedule()
    movements = stack_movements([RandomMovements().draw(robot, schedule, rng) for rng in draws])
    reference = movements.reference(TIME)
    servo = DigitalTwin(robot).respond(reference, TIME)
    physics = PhysicsEngine(robot, threads=2).angles(Drive(reference), TIME)

    counts = robot.servo_units.to_counts
    wanted = counts(movements.target)
    direction = np.sign(np.diff(wanted, axis=1, prepend=counts(movements.initial)[:, None]))
    settled = physics[:, 200::200]
    error = counts(settled) - wanted
    arms = lever_arms(settled)
    expected = FITTED[:, 0] + FITTED[:, 1] * arms + FITTED[:, 2] * direction
    off = error - expected
    found = fit(error, arms, direction)
    left = error - (found[:, 0] + found[:, 1] * arms + found[:, 2] * direction)
    past = [overshoot(movements, angle) / np.deg2rad(0.24) for angle in (servo, physics)]

    print(
        "settled, physics less servo engine [counts]: mean, sd, largest; then, servo engine first,"
    )
    print("slope by lever arm [counts/m], friction [counts], scatter left by physics [counts],")
    print("ramp lag [s], overshoot [counts]: mean and largest of each")
    for k, name in enumerate(robot.motor_names):
        lags = [lag(movements, reference, angle, k) for angle in (servo, physics)]
        print(
            f"{name}: {off[..., k].mean():5.2f} {off[..., k].std():5.2f} "
            f"{np.abs(off[..., k]).max():5.2f} | {FITTED[k, 1]:6.1f} {found[k, 1]:6.1f} | "
            f"{FITTED[k, 2]:5.2f} {found[k, 2]:5.2f} | {left[..., k].std():4.2f} | "
            f"{lags[0]:.3f} {lags[1]:.3f} | "
            + " ".join(f"{p[..., k].mean():4.2f} {p[..., k].max():5.2f}" for p in past)
        )


if __name__ == "__main__":
    main()
