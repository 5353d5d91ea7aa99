"""Whether the tool leaves the straight way between two commands: a log then tells too few of them.

A command once a second, joined by lines, is not the curve that an arm follows. Its tool is near the
lines at the commands and far off between. Errors and stuck motors are off at the commands too:

    strays = median over stretches of  |off at mid| / max |off at either end|  >  1.4

Section: docs/inference.md#moments
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray, as_floats
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.lag_offset import command_at

STRAYS = 1.4
"""Median factor by which the tool is further off between commands than at them: 1.2 at most in
simulated arms that move straight, 1.7 to 7 where a curve is told once a second."""
ENDS, MIDDLE = 0.15, 0.35
"""Readings count as at a command within this share of a stretch, between two from that share on."""
FEWEST = 4
"""Stretches from which that is told."""
SEEN = 2.0
"""How far off a tool is at least between commands, in deviations of a healthy arm at rest."""


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
        middle, ends, deviation = _off(evidence, model, run, lag_s)
        if len(middle) >= FEWEST:
            found[run] = np.median(middle / np.maximum(ends, 1e-9)) > STRAYS
            found[run] &= np.median(middle / deviation) > SEEN
    return found


def _off(
    evidence: Evidence, model: HealthyModel, run: int, lag_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how far the tool is off in the middle of each stretch, and at its worse end.

    Returns:
        Both, and the deviation of a healthy arm there, (stretch,) [m].
    """
    movements, seen = evidence.settled.movements, np.flatnonzero(evidence.read[run])
    when = as_floats(evidence.runs["time"].values)[seen] - lag_s
    expected, jacobian = model.sensors.expected(command_at(evidence, run, when))
    off = np.linalg.norm(evidence.readings.point[run][seen] - expected, axis=-1)
    spread = np.sum((jacobian * model.scatter) ** 2, axis=(-2, -1)) + 3.0 * model.path_noise**2
    starts, rows = np.sort(movements.start[run][movements.exists[run]]), list[list[float]]()
    for begin, end in pairwise(starts.tolist()):
        share = (when - begin) / (end - begin)
        first, last = np.abs(share) < ENDS, np.abs(share - 1.0) < ENDS
        middle = np.abs(share - 0.5) < 0.5 - MIDDLE
        if first.any() and last.any() and middle.any():
            worse = max(np.median(off[first]), np.median(off[last]))
            deviation = np.sqrt(np.median(spread[middle]))
            rows.append([float(np.median(off[middle])), float(worse), float(deviation)])
    middles, ends, deviations = np.array(rows).reshape(-1, 3).T
    return middles, ends, deviations
