"""How much later than the commands' the clock of the tool is, by the share of the way it has done.

    s(t) = (x(t) - A) . (B - A) / |B - A|^2,    s(t) ~ s_predicted(t - late - lag)

with A, B where the tool itself rests before and after a movement, and s_predicted the same of the
path of the commands. Frames, senses, zeros and held motors nearly cancel, so that the clock is
found before all else.

    p(movement | late) = (1 - r) p(readings | late) + r mean over d > 0 of p(readings | late + d)

for movements that start late by d with probability r.

Section: docs/inference.md#set-ups
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import BoolArray, FloatArray, as_floats
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel

LATEST_S, STEP_S, FINE_S = 2.0, 0.1, 0.02
"""Clocks that are considered: up to so far apart, in such steps, and finer near the best [s]."""
REST_S = 0.5
"""Time before a movement in which the tool rests [s]."""
BEFORE_S, AFTER_S = 0.4, 0.9
"""Readings that count: from so long before a movement's start to so long after its end [s]."""
SHARE_DEVIATION, TIME_DEVIATION_S = 0.05, 0.03
"""How far the share done may be off, and the time [-, s]."""
OUTLYING, OUTLIER_DEVIATION = 0.2, 0.5
"""Share of readings that are further off, and by how much."""
TEMPER, READINGS = 0.5, 15
"""What a reading counts, since neighbours err together, and how many a movement has."""
LATE_RATE = 0.1
"""Probability of a late start."""
LOOKED_AT = 8
"""Runs by which clocks are judged, evenly spread."""
CLOCK_RATE = 0.01
"""Probability that the clocks are apart."""
FITS = 1.2
"""Median log density of the shares done above which the clocks are not looked into: 1.5 to 1.8 in
runs of a real arm with right clocks, 0.9 and less with clocks 0.2 s apart."""

UNKNOWN_LAG_S = 0.2
"""An arm that nobody has calibrated may trail its commands by so much; a clock that is behind by
what is left of it is not told from that. Emulated UR5es: 0.05 to 0.19 s; SO-101: 0.13 to 0.17 s."""


@dataclass(frozen=True)
class ClockPosterior:
    """What is believed of the clocks of some runs.

    Attributes:
        late_s: The most probable difference [s].
        apart: Probability that there is one.
    """

    late_s: float = 0.0
    apart: float = 0.0


@dataclass(frozen=True)
class Way:
    """The readings about one movement.

    Attributes:
        time: When they were taken, (reading,) [s].
        point: Where the tool was, (reading, axis) [m].
        start: When it was commanded [s].
        end: When its ramps end [s].
        following: When the next one starts [s].
        grid: Times of the predicted path, (time,) [s].
        predicted: The path of the commands, (time, axis) [m].
    """

    time: FloatArray
    point: FloatArray
    start: float
    end: float
    following: float
    grid: FloatArray
    predicted: FloatArray

    def log_density(self, late: FloatArray, lag_s: float, unmoved_m: float) -> FloatArray:
        """Return the log density of the shares done, for clocks so late each, (late,).

        Args:
            late: How late the tool's clock is, (late,) [s].
            lag_s: Lag of the motion behind the command [s].
            unmoved_m: A way that is shorter says nothing [m].
        """
        at = self.time - late[:, None]
        before = (at > self.start - REST_S) & (at < self.start)
        rest = max(self.following - REST_S, self.end + STEP_S)
        after = (at > rest) & (at < self.following)
        seen = (at > self.start - BEFORE_S) & (at < min(self.end + AFTER_S, self.following))
        A, B = self._median(before), self._median(after)
        ends = [self._at(np.array([when]))[0] for when in (self.start, self.end + STEP_S)]
        way, expected_way = B - A, ends[1] - ends[0]
        told = np.interp(at - lag_s, self.grid, self._share(self.predicted, ends[0], expected_way))
        ahead = np.interp(
            at - lag_s + STEP_S, self.grid, self._share(self.predicted, ends[0], expected_way)
        )
        long = np.einsum("la,la->l", way, way)
        done = np.einsum("lra,la->lr", self.point - A[:, None], way)
        done = done / np.maximum(long, unmoved_m**2)[:, None]
        off = done - told
        deviation = np.hypot(SHARE_DEVIATION, TIME_DEVIATION_S * (ahead - told) / STEP_S)
        near = np.exp(-0.5 * (off / deviation) ** 2) / deviation
        far = np.exp(-0.5 * (off / OUTLIER_DEVIATION) ** 2) / OUTLIER_DEVIATION
        density = np.log((1.0 - OUTLYING) * near + OUTLYING * far + 1e-3) - 0.5 * np.log(2 * np.pi)
        counted = np.where(seen & np.isfinite(density), density, 0.0)
        total = counted.sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
        moved = (long > unmoved_m**2) & (float(expected_way @ expected_way) > unmoved_m**2)
        return np.where(moved & (seen.sum(axis=1) > 2), total, np.nan)

    def _median(self, which: BoolArray) -> FloatArray:
        kept = np.where(which[..., None], self.point, np.nan)
        found = np.full((len(which), self.point.shape[-1]), np.nan)
        some = which.sum(axis=1) > 1
        found[some] = np.nanmedian(kept[some], axis=1)
        return found

    def _at(self, when: FloatArray) -> FloatArray:
        return np.stack([np.interp(when, self.grid, axis) for axis in self.predicted.T], axis=-1)

    @staticmethod
    def _share(path: FloatArray, begin: FloatArray, way: FloatArray) -> FloatArray:
        return np.asarray((path - begin) @ way / max(float(way @ way), 1e-12))


def clock_posterior(seen: Evidence, model: HealthyModel) -> ClockPosterior:
    """Return what is believed of the tool's clock, by some of the runs.

    Args:
        seen: The runs.
        model: The healthy robot.
    """
    ways = _ways(seen, model)
    lag, unmoved = model.lag_s, model.settings.unmoved_m
    told = [way.log_density(np.zeros(1), lag, unmoved)[0] for way in ways]
    ways = [way for way, says in zip(ways, told, strict=True) if np.isfinite(says)]
    if not ways or np.nanmedian(told) > FITS:
        return ClockPosterior()
    coarse = np.arange(-LATEST_S, LATEST_S + STEP_S / 2, STEP_S)
    says = _together(ways, coarse, lag, unmoved)
    nothing = int(np.argmin(np.abs(coarse)))
    prior = np.full(len(coarse), np.log(CLOCK_RATE / (len(coarse) - 1)))
    prior[nothing] = np.log1p(-CLOCK_RATE)
    log_joint = says.sum(axis=0) + prior
    share = np.exp(log_joint - log_sum(log_joint, axis=0))
    best = int(np.argmax(share))
    if best == nothing:
        return ClockPosterior(0.0, float(1.0 - share[nothing]))
    fine = coarse[best] + np.arange(-STEP_S, STEP_S + FINE_S / 2, FINE_S)
    late = float(fine[np.argmax(_together(ways, fine, lag, unmoved).sum(axis=0))])
    if model.imperfections.of_class and 0.0 < late <= UNKNOWN_LAG_S - lag:
        return ClockPosterior()
    return ClockPosterior(late, float(1.0 - share[nothing]))


def _ways(seen: Evidence, model: HealthyModel) -> list[Way]:
    """Return the readings about the movements of some runs."""
    time, command = seen.time, seen.command
    known: Movements = seen.settled.movements
    some = np.unique(np.linspace(0, len(command) - 1, LOOKED_AT).astype(np.int64))
    found = []
    for run in some:
        read = seen.readings.seen[run]
        predicted = model.twin.path(command[run])
        point, at = seen.readings.point[run][read], time[read]
        starts = known.start[run][known.exists[run]]
        for m, start in enumerate(starts):
            end = start + float(known.ramp_duration[run, m].max())
            last = min(end + 2.0 * REST_S, at[-1]) if len(at) else end
            following = starts[m + 1] if m + 1 < len(starts) else last
            found.append(Way(at, point, float(start), end, float(following), time, predicted))
    return found


def _together(ways: list[Way], late: FloatArray, lag_s: float, unmoved_m: float) -> FloatArray:
    """Return what each movement says of clocks, with late starts summed over, (movement, late)."""
    delays = np.arange(1, 17) * STEP_S
    both = np.concatenate([late, (late[:, None] + delays).ravel()])
    asked, place = np.unique(np.rint(both / FINE_S).astype(np.int64), return_inverse=True)
    rows = []
    for way in ways:
        says = way.log_density(as_floats(asked * FINE_S), lag_s, unmoved_m)
        told = np.isfinite(says)  # none where no reading falls into the movement
        least = says[told].min() if told.any() else 0.0
        says = TEMPER * READINGS * np.where(told, says, least)
        punctual, delayed = says[place[: len(late)]], says[place[len(late) :]]
        delayed = log_sum(delayed.reshape(len(late), -1), axis=1) - np.log(len(delays))
        rows.append(np.logaddexp(np.log1p(-LATE_RATE) + punctual, np.log(LATE_RATE) + delayed))
    return np.array(rows)
