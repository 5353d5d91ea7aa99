"""Constant offsets between commands and readings of each joint: zeros that are not where they were.

Where command and reading of a joint stand still, a healthy motor's reading differs from the command
by its settled error; an offset adds to it:

    reading - command = offset + bias + compliance * load - friction * direction + scatter

Offset, bias and friction are normal and integrated out exactly, compliance and scatter on a grid.

Section: docs/reading_logs.md#joint-offsets
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from failuretwin.core.hypothesis import SURE, Interval
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.nonidealities import Imperfections, Variation
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, sag
from failuretwin.failure_behavior.modes import EncoderBias

if TYPE_CHECKING:
    import xarray as xr

STILL_RAD, STILL_S = 3.5e-3, 0.3
"""Joints stand still if they turn through no more in this time: about 0.2 deg [rad, s]."""
TRAVEL_RAD = 0.02
"""Travel of a command from which it makes another stop, and has a direction [rad]."""
FEWEST_STOPS = 4
FOLLOWS = 0.5
"""A joint follows its command if its errors spread by less than this share of the commands'."""
COMPLIANCE_SPREAD, SCATTER_SPREAD = 1.0, 0.7
"""Prior deviations of the logarithms of compliance and scatter; assumed, wider than within a class:
recording programs set gains of their own, and hands hold objects."""
OFFSET_RAD = 0.2
"""Prior deviation of an offset [rad]."""
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


class _Stops(NamedTuple):
    """Stops of one joint: rows of the run set (run, time) and direction of the travel before."""

    run: list[int]
    row: list[int]
    direction: list[float]
    error: list[float]


def joint_offsets(runs: xr.Dataset, robot: Robot, known: Imperfections) -> tuple[JointOffset, ...]:
    """Return the offset of each joint that follows its commands and stops often enough.

    A stuck motor does not follow, so it has none.

    Args:
        runs: Runs with `command` and `position`, of one robot.
        robot: The robot.
        known: Its healthy behaviour; without settled errors or their variation, its class counts.
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
        at = command[stops.run, stops.row]
        errors = np.array(stops.error)
        if len(at) < FEWEST_STOPS or errors.std() > FOLLOWS * at[:, k].std():
            continue
        load = sag(robot, at, np.asarray(settling.compliance), settling.payload)[:, k]
        rows = np.stack([np.ones(len(at)), -np.array(stops.direction)], axis=1)
        found.append(_offset(motor, k, errors, rows, load, settling, variation))
    return tuple(found)


def _stops(command: FloatArray, position: FloatArray, time: FloatArray) -> _Stops:
    """Return the stops of one joint, of commands and readings (run, time) [rad]."""
    found = _Stops([], [], [], [])
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
            found.run.append(run)
            found.row.append(int(settled[0]))
            found.direction.append(float(np.sign(here - before[far[-1]])) if len(far) else 0.0)
            found.error.append(float(np.median(seen[settled] - asked[settled])))
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
    motor: str,
    k: int,
    errors: FloatArray,
    rows: FloatArray,
    load: FloatArray,
    settling: Settling,
    variation: Variation,
) -> JointOffset:
    """Return the offset of motor `k` from its errors (stop,) [rad] at its stops.

    Args:
        motor: Its name.
        k: Its number in the chain.
        errors: Reading minus command, (stop,) [rad].
        rows: Factors of offset and friction, (stop, 2).
        load: Sag of the class, (stop,) [rad].
        settling: Settled errors of the class.
        variation: Their variation within it.
    """
    from scipy.special import ndtr

    mean = np.array([settling.bias[k], settling.friction[k]])
    spread = np.array([variation.bias[k], (variation.friction or variation.bias)[k]])
    sag_factor, scatter_factor = np.exp([COMPLIANCE_SPREAD * NODES, SCATTER_SPREAD * NODES])
    prior = -0.5 * (NODES[:, None] ** 2 + NODES**2)
    wide = np.hypot(spread, [OFFSET_RAD, 0.0])
    log_healthy, log_off = np.empty((2, *prior.shape))
    centre, width = np.empty((2, *prior.shape))
    for at in np.ndindex(prior.shape):
        left = errors - sag_factor[at[0]] * load - rows @ mean
        scatter = scatter_factor[at[1]] * settling.scatter[k]
        log_healthy[at] = _fit(left, rows, spread, scatter)[0]
        log_off[at], centre[at], width[at] = _fit(left, rows, wide, scatter)
    top = max(float((prior + log_off).max()), float((prior + log_healthy).max()))
    weight = np.exp(prior + log_off - top)
    odds = EncoderBias.prior_odds * weight.sum() / np.exp(prior + log_healthy - top).sum()
    weight /= weight.sum()
    width = np.hypot(width, spread[0])  # a healthy motor has a bias, too
    size = float(np.sum(weight * centre))
    grid = size + np.linspace(-1.0, 1.0, 4001) * 8.0 * float(np.max(width))
    below = np.einsum("cs,csg->g", weight, ndtr((grid - centre[..., None]) / width[..., None]))
    low, high = np.interp([0.05, 0.95], below, grid)
    third = (len(errors) + 2) // 3
    change = abs(float(np.median(errors[:third]) - np.median(errors[-third:])))
    sure, steady = float(odds / (1.0 + odds)), change < 0.5 * abs(size)
    return JointOffset(motor, size, (float(low), float(high)), sure, len(errors), steady)


def _fit(
    left: FloatArray, rows: FloatArray, spread: FloatArray, scatter: float
) -> tuple[float, float, float]:
    """Return log evidence, mean and deviation of the first factor: (stop,) errors of normal rows.

    left = rows @ theta + scatter * normal,    theta = spread * normal
    """
    root = rows * spread
    precision = root.T @ root / scatter**2 + np.eye(2)
    covariance = np.linalg.inv(precision)
    pull = root.T @ left / scatter**2
    fit = left @ left / scatter**2 - pull @ covariance @ pull
    log_evidence = -0.5 * (fit + np.linalg.slogdet(precision)[1]) - len(left) * np.log(scatter)
    mean, deviation = (covariance @ pull)[0], np.sqrt(covariance[0, 0])
    return float(log_evidence), float(spread[0] * mean), float(spread[0] * deviation)
