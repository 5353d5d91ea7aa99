"""Residual of a run that no known fault explains, as displacements of one motor.

    d_m = phi*_m - phi_m(healthy),    s_m^2 = 1 / P_m + s^2
    k = argmax over motors of sum over m of [L_m(phi*) - log(P_m) / 2]

with the angle phi* that brings the tool nearest to where it was seen, its precision P, the scatter
s of the motor, and the log density L there. The sum is Laplace's integral over a displacement that
each movement draws anew. Of each movement the most probable outcome counts.

Section: docs/store.md#unknown-faults
"""

from __future__ import annotations

import numpy as np

from failuretwin.core.hypothesis import SURE, MotorResidual
from failuretwin.core.numerics import log_fall, log_sum
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.inference.movements.joint_likelihood import LEAST_PRECISION, JointLikelihood
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.set_ups.set_ups import shown, spoken
from failuretwin.inference.set_ups.wrong_setup import ALONE

EXPLAINED = 25.0
"""Squared distance up to which a motor that stands elsewhere explains a position."""


def lone_motor(likelihood: RunLikelihood, run: int, movements: BoolArray) -> str:
    """Return which motor alone explains some movements of a run, in words; empty: none surely does.

    Args:
        likelihood: The runs.
        run: Index of the run.
        movements: The movements, (movement,).
    """
    model = likelihood.model
    if likelihood.evidence.on_the_way[run] or not movements.any():
        return ""
    says = [_log_evidence(one)[run, movements] for one in likelihood.findings.profiles]
    total = np.array([one.max(axis=1).sum() for one in says])
    motor = int(np.argmax(total))
    if total[motor] - log_sum(total, axis=0) < np.log(SURE):
        return ""
    profile, best = likelihood.findings.profiles[motor], says[motor].argmax(axis=1)
    at = np.flatnonzero(movements)
    if (profile.min_distance2[run, at, best] > EXPLAINED).any():
        return ""
    shift = profile.turned((profile.mode - profile.faulty_baseline)[run, at, best])
    size, unit = shown(model.twin.robot, motor)
    farthest = size * float(shift[np.abs(shift).argmax()])
    return (
        f"{spoken(model.twin.robot, motor)} {ALONE}, up to {farthest:+.3g} {unit} off: "
        "more than the faults that are considered"
    )


def motor_residual(likelihood: RunLikelihood, run: int) -> MotorResidual | None:
    """Return the displacements of the motor that explains a run best; None: it never rests.

    Args:
        likelihood: The runs.
        run: Index of the run.
    """
    usable = np.flatnonzero(likelihood.usable[run])
    if likelihood.evidence.on_the_way[run] or not len(usable):
        return None
    model, profiles = likelihood.model, likelihood.findings.profiles
    log_evidence = [_log_evidence(one)[run, usable].max(axis=1).sum() for one in profiles]
    motor = int(np.argmax(log_evidence))
    best, profile = _log_evidence(profiles[motor])[run, usable].argmax(axis=1), profiles[motor]

    def at_best(values: FloatArray) -> FloatArray:
        return np.asarray(values[run, usable, best])

    precision = np.maximum(at_best(profile.precision), LEAST_PRECISION)
    healthy = at_best(profile.faulty_baseline)
    shift = profile.turned(at_best(profile.mode) - healthy)
    deviation = np.sqrt(1.0 / precision + profile.scatter**2)
    direction = np.sign(likelihood.outcomes.direction[run, usable, best, motor])
    lists = (tuple(v.tolist()) for v in (shift, deviation, healthy, direction))
    unit = "m" if model.twin.robot.slides[motor] else "rad"
    return MotorResidual(model.motor_names[motor], unit, *lists)


def _log_evidence(profile: JointLikelihood) -> FloatArray:
    """Return the log density of each position with this motor anywhere, (run, movement, outcome).

    Up to a constant of the motor, its range.
    """
    nearest = log_fall(profile.min_distance2, profile.dof, profile.dims)
    width = -0.5 * np.log(np.maximum(profile.precision, LEAST_PRECISION))
    return np.asarray(profile.log_weight + nearest + width)
