"""How far a moving tool trails its commands beside what is usual, before anything else is judged.

    shift = argmax of  log p(shift) + log sum over j of p(j) integral p(b)
                       prod over k of t_4(x_k - y(q(t_k - lag - shift)) - J_j b)^0.3 db

The engine is linear in the lag of each motor, which holds for some hundredths of a second. Clocks
are further apart, and so are robots that nobody has calibrated: readings on the way are compared
with the command at the likeliest lag. No motor j or one may be off by b all along; other faults
leave outliers at every shift.

Section: docs/inference.md#moments
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.numerics import log_fall, log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel

FARTHEST_S, STEP_S, FINE_S = 0.6, 0.02, 0.004
"""Shifts that are considered: up to so far, in such steps, and finer near the best [s]."""
USUAL_S = 0.03
"""Scale of the Cauchy prior of the shift [s]; assumed."""
TAIL_DOF = 4.0
"""Degrees of freedom of what a reading is off by."""
TEMPER, READINGS = 0.3, 60
"""What a reading counts, since neighbours err together, and how many of a run are looked at."""
OFF_RATE, OFF_RAD, OFF_ROUNDS = 0.1, 0.3, 4
"""Share of runs in which a motor is off all along, which looks like a lag while motors go one way,
and its deviation [rad]; assumed. Rounds of reweighted least squares to find by how much."""
GAIN_NATS = 3.0
"""By how much a shift explains the readings better than none where it counts."""
RUNS = 32
"""Runs that are looked at, evenly spread."""
CORNER_S = 0.04
"""Speed is the mean over twice that [s]."""


def lag_offset(evidence: Evidence, model: HealthyModel, runs: IntArray) -> float:
    """Return by how much more than usual some runs of one set-up trail their commands [s].

    Args:
        evidence: What all runs say.
        model: The healthy robot.
        runs: Those that hardly rest; some of them are looked at.
    """
    if not len(runs):
        return 0.0
    some = runs[np.unique(np.linspace(0, len(runs) - 1, RUNS).astype(np.int64))]
    way, best, heights = _Way(evidence, model), 0.0, []
    for step, farthest in ((STEP_S, FARTHEST_S), (FINE_S, STEP_S)):
        count = round(farthest / step)
        shifts = as_floats(best + step * np.arange(-count, count + 1))
        height = -np.log1p((shifts / USUAL_S) ** 2)
        for run in some.tolist():
            height += way.log_density(run, shifts)
        best = float(shifts[np.argmax(height)])
        heights.append(height)
    told = heights[0][len(heights[0]) // 2]
    return best if heights[-1].max() > told + GAIN_NATS else 0.0


@dataclass(frozen=True)
class _Way:
    """Readings on the way, compared with their commands."""

    evidence: Evidence
    model: HealthyModel

    def log_density(self, run: int, shifts: FloatArray) -> FloatArray:
        """Return the log density of the readings of a run at some shifts, up to a constant."""
        model, seen = self.model, self._looked_at(run)
        time = self.evidence.time[seen]
        when = time[:, None] - model.lag_s - shifts
        told, before, after = (
            command_at(self.evidence, run, when + h) for h in (0.0, -CORNER_S, CORNER_S)
        )
        speed = (after - before) / (2.0 * CORNER_S)
        pose = model.settle(told, np.sign(speed), model.none_held)
        expected, jacobian = model.sensors.expected(pose)
        variance = model.scatter**2 + (model.start_jitter_s * speed) ** 2
        moved = np.sum(jacobian**2 * variance[..., None, :], axis=(-2, -1))
        dims = expected.shape[-1]
        scale = moved / dims + model.path_noise**2
        point = self.evidence.readings.point[run][seen][:, None]
        fits = _Fit(point - expected, scale)
        none = np.log1p(-OFF_RATE) + fits.log_density(np.zeros(expected.shape))
        off = [fits.log_off(jacobian[..., k]) for k in range(jacobian.shape[-1])]
        rate = np.log(OFF_RATE / len(off))
        return np.asarray(log_sum(np.stack([none, *(rate + one for one in off)]), axis=0))

    def _looked_at(self, run: int) -> IntArray:
        """Return readings while motors are told to move, evenly spread."""
        evidence, time = self.evidence, self.evidence.time
        movements, end = evidence.settled.movements, evidence.settled.end[run]
        moves: BoolArray = np.zeros(len(time), dtype=bool)
        for m in np.flatnonzero(movements.exists[run]).tolist():
            moves |= (time >= movements.start[run, m]) & (time <= end[m])
        seen = np.flatnonzero(evidence.read[run] & moves)
        count = min(len(seen), READINGS)
        return seen[np.unique(np.linspace(0, len(seen) - 1, count).astype(np.int64))]


@dataclass(frozen=True)
class _Fit:
    """Residuals of readings at some shifts, explained by a motor that is off or by none.

    Attributes:
        residual: (reading, shift, channel) [m].
        scale: Variance of each channel, (reading, shift) [m2].
    """

    residual: FloatArray
    scale: FloatArray

    def log_density(self, explained: FloatArray) -> FloatArray:
        """Return the log density of the readings less what explains them, (shift,)."""
        square, dims = self._square(explained), self.residual.shape[-1]
        density = log_fall(square, TAIL_DOF, dims) - 0.5 * dims * np.log(self.scale)
        return np.asarray(TEMPER * density.sum(axis=0))

    def log_off(self, lever: FloatArray) -> FloatArray:
        """Return the log density where one motor is off by b ~ N(0, OFF_RAD^2), (shift,).

        Args:
            lever: What the sensors show of b, (reading, shift, channel) [m/rad].
        """
        dims, off = self.residual.shape[-1], np.zeros(self.scale.shape[1])
        for _ in range(OFF_ROUNDS):
            square = self._square(lever * off[:, None])
            weight = TEMPER * (TAIL_DOF + dims) / (TAIL_DOF + square) / self.scale
            force = np.sum(weight * np.sum(lever * self.residual, axis=-1), axis=0)
            precision = np.sum(weight * np.sum(lever**2, axis=-1), axis=0)
            off = force / (precision + OFF_RAD**-2)
        prior = -0.5 * (off / OFF_RAD) ** 2 - 0.5 * np.log1p(precision * OFF_RAD**2)
        return self.log_density(lever * off[:, None]) + prior

    def _square(self, explained: FloatArray) -> FloatArray:
        return np.asarray(np.sum((self.residual - explained) ** 2, axis=-1) / self.scale)


def command_at(evidence: Evidence, run: int, when: FloatArray) -> FloatArray:
    """Return the command of a run at some times (...) [s], as (..., motor) [rad]."""
    told = evidence.command[run].T
    return np.stack([np.interp(when, evidence.time, one) for one in told], axis=-1)
