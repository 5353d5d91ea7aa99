"""Constant offsets between commands and readings of each joint: zeros that are not where they were.

Where command and reading of a joint stand still, a healthy motor's reading differs from the command
by its settled error; an offset adds to it:

    reading - command = offset + bias + compliance * load - friction * direction + scatter

Offset, bias, friction and compliance are normal and integrated out exactly, scatter on a grid.

Section: docs/reading_logs.md#joint-offsets
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp, softmax

from failuretwin.core.hypothesis import SURE, Interval
from failuretwin.core.runs import RunSet
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.nonidealities import Imperfections, Variation
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, sag
from failuretwin.failure_behavior.modes import EncoderBias

STILL_RAD, STILL_S = 3.5e-3, 0.3
"""Joints stand still if they turn through no more in this time: about 0.2 deg [rad, s]."""
TRAVEL_RAD = 0.02
"""Travel of a command from which it makes another stop, and has a direction [rad]."""
FEWEST_STOPS = 4
FOLLOWS = 0.5
"""A joint follows its command if its errors spread by less than this share of the commands'."""
SAG_SPREAD, SCATTER_SPREAD = 1.5, 0.7
"""Prior deviations of the compliance, as a share of that of the class, and of the logarithm of the
scatter; assumed, wider than within a class: recording programs set gains of their own, and hands
hold objects."""
OFFSET_RAD = 0.2
"""Prior deviation of an offset [rad]."""
Z_90 = 1.645
"""Half the 90 % interval of a normal distribution, in standard deviations."""
NODES = np.linspace(-2.5, 2.5, 21)
"""Nodes of a standard normal distribution."""


@dataclass(frozen=True)
class JointOffset:
    """Offset of a joint, reading minus command, the same in all runs.

    Attributes:
        motor: Its motor.
        size: Posterior mean, given that there is one [rad].
        interval_90: 90 % interval of the same [rad].
        probability: Probability that there is one.
        stops: Number of stops that it was judged by.
        steady: Whether the first and the last third of the stops agree: their medians differ by
            less than half of the size.
    """

    motor: str
    size: float
    interval_90: Interval
    probability: float
    stops: int
    steady: bool

    @property
    def found(self) -> bool:
        """Whether the offset is there by 95 %, and all the time."""
        return self.steady and self.probability >= SURE


def joint_offsets(runs: RunSet, robot: Robot, known: Imperfections) -> tuple[JointOffset, ...]:
    """Return the offset of each joint that follows its commands and stops often enough.

    A stuck motor does not follow, so it has none. Runs have `command` and `position`. Where the
    known healthy behaviour lacks settled errors or their variation, the arm's class counts.
    """
    if known.settling is None or known.variation is None or not known.variation.bias:
        known = generic_imperfections(robot)
    settling, variation = known.settling, known.variation
    if "position" not in runs or settling is None or variation is None:
        return ()
    command, position = (as_floats(runs[name].values) for name in ("command", "position"))
    time = as_floats(runs["time"].values)
    found = []
    for k, motor in enumerate(robot.motor_names):
        stops = _stops(command[..., k], position[..., k], time)
        if len(stops) < FEWEST_STOPS:
            continue
        run, row, direction, errors = map(np.array, zip(*stops, strict=True))
        at = command[run, row]
        if errors.std() > FOLLOWS * at[:, k].std():
            continue
        load = sag(robot, at, np.asarray(settling.compliance), settling.payload)[:, k]
        rows = np.stack([np.ones(len(at)), -direction, load], axis=1)
        found.append(_offset(motor, k, errors, rows, settling, variation))
    return tuple(found)


def _stops(
    command: FloatArray, position: FloatArray, time: FloatArray
) -> list[tuple[int, int, float, float]]:
    """Return run, row, direction of the travel before and error [rad] of each stop of one joint.

    Commands and readings are (run, time) [rad].
    """
    found = []
    for run, (asked, seen) in enumerate(zip(command, position, strict=True)):
        rows = np.flatnonzero(np.isfinite(seen))
        last: float | None = None
        for first, stop in _still(asked[rows], seen[rows], time[rows]):
            settled = rows[(first + stop) // 2 : stop]
            here = float(np.median(asked[settled]))
            before = asked[: rows[first]]
            far = np.flatnonzero(np.abs(before - here) > TRAVEL_RAD)
            if last is not None and abs(here - last) < TRAVEL_RAD:
                continue
            last = here
            direction = float(np.sign(here - before[far[-1]])) if len(far) else 0.0
            error = float(np.median(seen[settled] - asked[settled]))
            found.append((run, int(settled[0]), direction, error))
    return found


def _still(asked: FloatArray, seen: FloatArray, time: FloatArray) -> list[tuple[int, int]]:
    """Return the stretches in which command and reading stand still, first and stop row."""
    found, first = [], 0
    while first < len(asked):
        low, high = np.array([[asked[first], seen[first]]] * 2)
        stop = first + 1
        while stop < len(asked):
            here = asked[stop], seen[stop]
            low, high = np.minimum(low, here), np.maximum(high, here)
            if np.max(high - low) > STILL_RAD:
                break
            stop += 1
        if time[stop - 1] - time[first] >= STILL_S:
            found.append((first, stop))
            first = stop
        else:
            first += 1
    return found


def _offset(
    motor: str, k: int, errors: FloatArray, rows: FloatArray, settling: Settling, doubt: Variation
) -> JointOffset:
    """Return the offset of motor `k` from its errors (stop,) [rad] at its stops.

    Args:
        motor: Its name.
        k: Its number in the chain.
        errors: Reading minus command, (stop,) [rad].
        rows: Factors of constant error, friction and sag of the class, (stop, 3).
        settling: Settled errors of the class.
        doubt: Their variation within it.
    """
    friction = (doubt.friction or doubt.bias)[k]
    left = errors - rows @ [settling.bias[k], settling.friction[k], 1.0]
    spread = np.array([doubt.bias[k], friction, SAG_SPREAD])
    wide = np.hypot(spread, [OFFSET_RAD, 0.0, 0.0])
    scatter = settling.scatter[k] * np.exp(SCATTER_SPREAD * NODES)
    log_healthy, _, _ = _fit(left, rows, spread, scatter)
    log_off, centre, width = _fit(left, rows, wide, scatter)
    odds = EncoderBias.prior_odds * float(np.exp(logsumexp(log_off) - logsumexp(log_healthy)))
    weight = softmax(log_off)
    size = float(weight @ centre)
    # A healthy motor has a constant error, too.
    deviation = float(np.sqrt(weight @ (width**2 + (centre - size) ** 2) + spread[0] ** 2))
    third = (len(errors) + 2) // 3
    change = abs(float(np.median(errors[:third]) - np.median(errors[-third:])))
    sure, steady = odds / (1.0 + odds), change < 0.5 * abs(size)
    interval = size - Z_90 * deviation, size + Z_90 * deviation
    return JointOffset(motor, size, interval, sure, len(errors), steady)


def _fit(
    left: FloatArray, rows: FloatArray, spread: FloatArray, scatter: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return log evidence, mean and deviation of the first factor for each scatter, (node,) each.

    left = rows @ theta + scatter * normal,    theta = spread * normal
    """
    root = (rows * spread) / scatter[:, None, None]
    left = left / scatter[:, None]
    precision = np.swapaxes(root, 1, 2) @ root + np.eye(len(spread))
    covariance = np.linalg.inv(precision)
    pull = np.einsum("nst,ns->nt", root, left)
    mean = np.einsum("ntu,nu->nt", covariance, pull)
    fit = np.sum(left**2, axis=1) - np.sum(pull * mean, axis=1)
    log_evidence = -0.5 * (fit + np.linalg.slogdet(precision)[1] + NODES**2)
    log_evidence -= left.shape[1] * np.log(scatter)
    return log_evidence, spread[0] * mean[:, 0], spread[0] * np.sqrt(covariance[:, 0, 0])
