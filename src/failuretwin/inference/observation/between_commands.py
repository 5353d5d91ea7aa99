"""Whether the tool leaves the straight way between two commands: a log then tells too few of them.

A command once a second, joined by lines, is not the curve that an arm follows. Its tool is near the
lines at their corners and far off between. Errors and stuck motors are off at the corners too:

    strays in a stretch from corner to corner:  |off at mid| / max |off at either end|  >  1.4

A motor that is stuck hides this from then on. Where commands come at a steady rate, it is told by a
quarter of the stretches, else by half of them.

Section: docs/inference.md#moments
"""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.lag_offset import command_at

TOO_SELDOM = (
    "the tool is not seen at rest after any movement, and the commands are too far apart in time "
    "to tell its way between them"
)
"""Why such a run allows no verdict."""
STRAYS = 1.4
"""Factor by which the tool is further off between corners than at them."""
SEEN = 2.0
"""How far off a tool is at least between corners, in deviations of a healthy arm at rest."""
SHARE, SHARE_STEADY = 0.5, 0.25
"""Share of the stretches in which it is so, and where commands come at a steady rate. Simulated
curves told once a second: 0.4 to 0.9, 0.1 to 0.5 with a stuck motor. Arms that move straight: 0;
0.4 at most with a motor that sticks now and then."""
STEADY = 0.2
"""Largest deviation of a steady stretch from the median, as a share of it."""
ENDS, MIDDLE = 0.15, 0.35
"""Readings count as at a corner within this share of a stretch, between two from that share on."""
FEWEST = 4
"""Stretches from which that is told."""
LEAST_S, LEAST_STEADY_S = 0.7, 0.25
"""Shortest stretch that counts [s], and where commands come at a steady rate: lines between closer
commands are near enough to a curve; an arm that lags leaves those of short ramps."""
CORNER_RAD_S, SAME_CORNER_S = 1e-3, 0.05
"""A command turns a corner where its speed changes by more [rad/s]; corners this near are one
[s]."""


def strays_between(
    evidence: Evidence, model: HealthyModel, runs: BoolArray, lag_s: float
) -> BoolArray:
    """Return in which runs the tool leaves the straight way between its commands, (run,).

    Args:
        evidence: What the runs say.
        model: The healthy robot.
        runs: Which runs are looked at, (run,).
        lag_s: How far the tool trails its commands [s].
    """
    found: BoolArray = np.zeros(len(runs), dtype=bool)
    for run in np.flatnonzero(runs).tolist():
        command, time = evidence.command, evidence.time
        stretches = _stretches(command[run], time)
        length = np.diff(stretches, axis=1)[:, 0]
        steady = len(length) >= FEWEST and _steady(length)
        least, share = (LEAST_STEADY_S, SHARE_STEADY) if steady else (LEAST_S, SHARE)
        middle, ends, deviation = _off(evidence, model, run, lag_s, stretches[length >= least])
        if len(middle) >= FEWEST:
            strays = (middle > STRAYS * ends) & (middle > SEEN * deviation)
            found[run] = strays.mean() >= share
    return found


def _off(
    evidence: Evidence, model: HealthyModel, run: int, lag_s: float, stretches: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how far the tool is off in the middle of stretches (begin, end), and at the worse end.

    Returns:
        Both, and the deviation of a healthy arm there, (stretch,) [m].
    """
    seen = np.flatnonzero(evidence.read[run])
    when = evidence.time[seen] - lag_s
    expected, jacobian = model.sensors.expected(command_at(evidence, run, when))
    off = np.linalg.norm(evidence.readings.point[run][seen] - expected, axis=-1)
    spread = np.sum((jacobian * model.scatter) ** 2, axis=(-2, -1)) + 3.0 * model.path_noise**2
    rows = list[list[float]]()
    for begin, end in stretches.tolist():
        share = (when - begin) / (end - begin)
        first, last = np.abs(share) < ENDS, np.abs(share - 1.0) < ENDS
        middle = np.abs(share - 0.5) < 0.5 - MIDDLE
        if first.any() and last.any() and middle.any():
            worse = max(np.median(off[first]), np.median(off[last]))
            deviation = np.sqrt(np.median(spread[middle]))
            rows.append([float(np.median(off[middle])), float(worse), float(deviation)])
    middles, ends, deviations = np.array(rows).reshape(-1, 3).T
    return middles, ends, deviations


def _stretches(command: FloatArray, time: FloatArray) -> FloatArray:
    """Return where no motor's command (time, motor) turns, begin and end, (stretch, 2) [s].

    A curve turns at every sample: it has none.
    """
    speed = np.diff(command, axis=0) / np.diff(time)[:, None]
    turns = np.abs(np.diff(speed, axis=0)).max(axis=1) > CORNER_RAD_S
    corners = np.concatenate([time[:1], time[1:-1][turns], time[-1:]])
    pairs = np.stack([corners[:-1], corners[1:]], axis=1)
    return np.asarray(pairs[np.diff(corners) > SAME_CORNER_S])


def _steady(length: FloatArray) -> bool:
    """Return whether nearly all stretches last equally long, (stretch,) [s]."""
    low, middle, high = np.quantile(length, [0.1, 0.5, 0.9])
    return bool(max(high - middle, middle - low) <= STEADY * middle)
