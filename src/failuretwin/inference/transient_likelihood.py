"""How well readings on the way agree with motors that go from one pose to another in given times.

When exactly a movement began is not known: the lag differs from run to run, and a stalled bus may
hold the start up for a second. All motors share that delay, and it is summed over.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin.core.numerics import log_fall, log_norm, log_of, log_sum
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.evidence import SettledEvidence, TransientSamples
from failuretwin.inference.healthy_model import HealthyModel
from failuretwin.inference.start_delay import StartNodes

KNOTS = 11
"""Instants of a ramp at which the path is computed; between them it is a straight line."""
ROUGHNESS_M = 0.002
"""What straight lines between the knots and bent ramps leave out [m]."""
SEEN, UNSEEN = 0.3, 12.0
"""Factors on the variance of the settled scatter, where both ends of a movement were seen and where
not. All readings of a movement share its ends, so that each tells a twelfth of what is not known of
them; what is known of them is taken as it was seen."""
JITTER_S = 0.012
"""Standard deviation of the stamps of single readings [s], on top of the shared lag."""
DOF = 4.0
"""Degrees of freedom of single readings: heavy tails."""
GLITCH_RATE = 0.03
"""Share of readings that may be anywhere within reach [-]."""


@dataclass(frozen=True)
class TransientHypothesis:
    """What motors do in some movements, for several cases at once.

    Attributes:
        run: Which run each movement belongs to, (item,).
        movement: Its number in the run, (item,).
        origin: Where each motor starts, (item, case, motor) [rad].
        destination: Where it goes, (item, case, motor) [rad].
        duration: How long it takes, (item, case, motor) [s].
        delay: How much later than the others it starts, (case, motor) [s].
        spread_m: How far the tool may stray from its way beside what is usual [m].
    """

    run: IntArray
    movement: IntArray
    origin: FloatArray
    destination: FloatArray
    duration: FloatArray
    delay: FloatArray
    spread_m: float = 0.0

    def __getitem__(self, some: IntArray) -> TransientHypothesis:
        """Return some of the movements."""
        return replace(
            self,
            run=self.run[some],
            movement=self.movement[some],
            origin=self.origin[some],
            destination=self.destination[some],
            duration=self.duration[some],
        )


@dataclass(frozen=True)
class TransientLikelihood:
    """Density of readings on the way.

    Attributes:
        model: The healthy robot.
        settled: Settled positions of the same runs: their movements and times.
        moving: Readings on the way.
    """

    model: HealthyModel
    settled: SettledEvidence
    moving: TransientSamples

    @cached_property
    def _late(self) -> FloatArray:
        """Log probability that each movement starts late, (run, movement)."""
        return log_of(self.model.late(self.settled.movements, self.settled.first_reading_delay))

    @cached_property
    def log_outlier(self) -> float:
        """Log density of a reading that is anywhere within reach, times the rate of glitches."""
        return float(np.log(GLITCH_RATE) - np.log(4.0 / 3.0 * np.pi * self.model.reach**3))

    def log_density(self, ramps: TransientHypothesis) -> FloatArray:
        """Return the log density of the readings of each movement, (item, case).

        Args:
            ramps: What the motors do in each case.
        """
        late = self._late[ramps.run, ramps.movement]
        found = np.full(ramps.origin.shape[:2], -np.inf)
        delay = self.model.start_delay
        punctual = log_of(-np.expm1(np.minimum(late, 0.0)))
        for starts, chance in ((delay.punctual, punctual), (delay.late, late)):
            some = np.flatnonzero(chance > -np.inf)
            if len(some) > 0:
                says = self._of_starts(ramps[some], starts) + chance[some, None]
                found[some] = np.logaddexp(found[some], says)
        return found

    def _of_starts(self, ramps: TransientHypothesis, starts: StartNodes) -> FloatArray:
        """Return the log density given that a movement begins at one of some times, (item, case).

        Args:
            ramps: What the motors do in each case.
            starts: Times after the command.
        """
        item = ramps.run, ramps.movement
        path, longest = self._path(ramps)
        variance = self._variance(ramps)[:, None, None, None] + ramps.spread_m**2
        # (item, 1, reading, start)
        since = self.moving.since[item][:, None, :, None] - starts.delay
        predicted, velocity = _along(path, longest, since)
        point = self.moving.point[item][:, None, :, None]
        error = [point[..., axis] - predicted[axis] for axis in range(3)]
        speed2 = sum(v * v for v in velocity)
        along2 = sum(e * v for e, v in zip(error, velocity, strict=True)) ** 2
        along2 /= np.maximum(speed2, 1e-12)
        error2 = sum(e * e for e in error)
        stretched = variance + speed2 * (JITTER_S**2 + starts.step_s**2 / 12.0)
        square = np.maximum(error2 - along2, 0.0) / variance + along2 / stretched
        log_at = log_fall(square, DOF) - 0.5 * np.log(stretched)
        log_at += log_norm(DOF) - np.log(variance) + np.log1p(-GLITCH_RATE)
        log_at = np.logaddexp(log_at, self.log_outlier)
        log_at *= self.moving.seen[item][:, None, :, None]
        return log_sum(log_at.sum(axis=2) + starts.log_weight, axis=-1)

    def _variance(self, ramps: TransientHypothesis) -> FloatArray:
        """Return the variance of a reading on each axis, (item,) [m2]."""
        _, jacobian = self.model.twin.path_and_jacobian(ramps.destination[:, 0])
        scaled = np.sum((jacobian * self.model.scatter) ** 2, axis=(-1, -2)) / 3.0
        doubt = self._doubt[ramps.run, ramps.movement]
        return doubt * scaled + self.model.path_noise**2 + ROUGHNESS_M**2

    @cached_property
    def _doubt(self) -> FloatArray:
        """Factor on the variance of the settled scatter, (run, movement)."""
        seen = self.settled.usable.copy()
        seen[:, 1:] &= self.settled.usable[:, :-1]
        return np.where(seen, SEEN, UNSEEN)

    def _path(self, ramps: TransientHypothesis) -> tuple[FloatArray, FloatArray]:
        """Return the tool at each knot, (item, case, knot, axis), and its time at the last one.

        The latter is (item, case) [s].
        """
        duration = ramps.duration * (1.0 - self.model.shortening)
        longest = np.maximum((duration + ramps.delay).max(axis=-1), 0.05)
        at = longest[..., None] * np.linspace(0.0, 1.0, KNOTS)
        since = at[..., None] - ramps.delay[:, None]  # (item, case, knot, motor)
        share = np.clip(since / np.maximum(duration, 1e-6)[..., None, :], 0.0, 1.0)
        travel = ramps.destination - ramps.origin
        pose = ramps.origin[..., None, :] + share * travel[..., None, :]
        return self.model.twin.path(pose), longest


def _along(
    path: FloatArray, longest: FloatArray, since: FloatArray
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return place and velocity of the tool at some times after the start.

    Args:
        path: The tool at each knot, (item, case, knot, axis) [m].
        longest: Time of the last knot, (item, case) [s].
        since: Times, (item, 1, reading, start) [s].

    Returns:
        For each axis, (item, case, reading, start), [m] and [m/s].
    """
    interval = longest[..., None, None] / (KNOTS - 1)
    knot = since / interval
    moving = ((knot > 0.0) & (knot < KNOTS - 1)) / interval
    knot = np.clip(knot, 0.0, KNOTS - 1)
    low = np.minimum(knot.astype(np.int64), KNOTS - 2)
    share = knot - low
    items, cases = longest.shape
    low += KNOTS * np.arange(items * cases).reshape(items, cases, 1, 1)
    place, velocity = [], []
    for axis in range(3):
        values = np.ascontiguousarray(path[..., axis]).ravel()
        before = values[low]
        step = values[low + 1] - before
        place.append(before + share * step)
        velocity.append(step * moving)
    return place, velocity
