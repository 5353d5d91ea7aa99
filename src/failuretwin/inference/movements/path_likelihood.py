"""What readings on the way say of motors that go from one pose to another.

    log p(y) = log sum over tau of p(tau) prod over readings of p(y; t - tau)
    p(y; t) = (1 - eps) t_4(y - y(t); v I + speed^2 (jitter^2 + step^2 / 12) along it) + eps / V

with the start delay tau, and the variance v of a reading: what is left of the scatter of both ends,
noise, and what straight lines between knots leave out.

Section: docs/inference.md#readings-on-the-way
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.numerics import along_polyline, log_fall, log_norm, log_of, log_sum
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.observation.evidence import SettledEvidence, TransientSamples
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.sensors import SensorStack
from failuretwin.inference.observation.start_delay import StartNodes

KNOTS = 11
"""Instants of a ramp at which the path is computed; between them it is a straight line."""
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
class PathLikelihood:
    """Log densities of the readings on the way along given paths.

    Attributes:
        model: The healthy robot.
        settled: Settled positions of the runs: their movements and times.
        moving: Readings on the way.
    """

    model: HealthyModel
    settled: SettledEvidence
    moving: TransientSamples

    def _of_runs(
        self,
        origin: FloatArray,
        destination: FloatArray,
        duration: FloatArray | None = None,
        delay: FloatArray | None = None,
        spread_m: float = 0.0,
    ) -> FloatArray:
        """Return `log_density` of all movements, (run, movement, case); 0 without readings."""
        item = np.nonzero(self.moving.seen.any(axis=-1))
        found = np.zeros(origin.shape[:-1])
        lasts = None if duration is None else duration[item]
        found[item] = self.log_density(
            item, origin[item], destination[item], lasts, delay, spread_m
        )
        return found

    def log_density(
        self,
        item: tuple[IntArray, ...],
        origin: FloatArray,
        destination: FloatArray,
        duration: FloatArray | None = None,
        delay: FloatArray | None = None,
        spread_m: float = 0.0,
    ) -> FloatArray:
        """Return the log density of the readings of some movements, (item, case).

        Args:
            item: Their runs and numbers, (item,) each.
            origin: Where each motor starts, (item, case, motor) [rad].
            destination: Where it goes, (item, case, motor) [rad].
            duration: How long it takes, (item, case, motor) [s]; None: as commanded.
            delay: How much later than the others it starts, (case, motor) [s]; None: no later.
            spread_m: How far the tool may stray from its way beside what is usual [m].
        """
        if duration is None:
            duration = self.settled.movements.ramp_duration[item][:, None]
        late = np.zeros(origin.shape[1:]) if delay is None else delay
        path, longest, lead = self._path(origin, destination, np.nan_to_num(duration), late)
        variance = self._variance(item, destination[:, 0]) + spread_m**2
        found = np.full(origin.shape[:2], -np.inf)
        for start, log_chance in self._starts:
            chance = log_chance[item]
            some = np.flatnonzero(chance > -np.inf)
            if len(some) > 0:
                at = tuple(index[some] for index in item)
                ways = path[some], longest[some], lead[some]
                says = self._of_starts(at, *ways, variance[some], start)
                found[some] = np.logaddexp(found[some], says + chance[some, None])
        return found

    @cached_property
    def _starts(self) -> tuple[tuple[StartNodes, FloatArray], ...]:
        """Punctual and late starts, and the log probability of each, (run, movement)."""
        late = log_of(self.model.late(self.settled.movements, self.settled.first_reading_delay))
        delay, on_time = self.model.start_delay, log_of(-np.expm1(np.minimum(late, 0.0)))
        return (delay.punctual, on_time), (delay.late, late)

    def _of_starts(
        self,
        item: tuple[IntArray, ...],
        path: FloatArray,
        longest: FloatArray,
        lead: FloatArray,
        variance: FloatArray,
        start: StartNodes,
    ) -> FloatArray:
        """Return log densities of movements that begin so late, (item, case).

        Args:
            item: Runs and numbers of movements, (item,) each.
            path: What is seen at each knot, (item, case, knot, axis) [m].
            longest: Time from the first knot to the last, (item, case) [s].
            lead: How long before the start the first one is, (item, case) [s].
            variance: Of a reading on each axis, (item,) [m2].
            start: How late.
        """
        since = self.moving.since[item][:, None, :, None] - start.delay  # (.., reading, start)
        if lead.any():
            since = since + lead[..., None, None]
        way = along_polyline(path, longest, since)
        point = self.moving.point[item][:, None, :, None]
        sensors, step_s = self.model.sensors, start.step_s
        log_at = log_density_on_way(point, *way, variance[:, None, None, None], step_s, sensors)
        log_at *= self.moving.seen[item][:, None, :, None]
        return log_sum(log_at.sum(axis=2) + start.log_weight, axis=-1)

    def _variance(self, item: tuple[IntArray, ...], destination: FloatArray) -> FloatArray:
        """Return the variance of a reading on each axis, (item,) [m2]; ends (item, motor) [rad]."""
        jacobian = self.model.sensors.jacobian_on_way(destination)
        axes = jacobian.shape[-2]
        scaled = np.sum((jacobian * self.model.scatter) ** 2, axis=(-1, -2)) / axes
        seen = self.settled.usable.copy()
        seen[:, 1:] &= self.settled.usable[:, :-1]
        rough = self.model.settings.path_roughness_m
        return np.where(seen[item], SEEN, UNSEEN) * scaled + self.model.path_noise**2 + rough**2

    def _path(
        self, origin: FloatArray, destination: FloatArray, duration: FloatArray, delay: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what is seen at each knot, (item, case, knot, axis) [m], and when knots are.

        The latter is the time from the first to the last and that from the first to the start,
        (item, case) [s] each; arguments as for `log_density`. What accelerates is seen at rest
        before and after, at a knot of its own.
        """
        duration = duration * (1.0 - self.model.shortening)
        longest = np.maximum((duration + delay).max(axis=-1), 0.05)
        longest = np.broadcast_to(longest, origin.shape[:2])
        beyond = 2 * self.model.sensors.accelerates
        step = longest / (KNOTS - 1)
        at = longest[..., None] * np.linspace(0.0, 1.0, KNOTS)
        if beyond:
            at = step[..., None] * np.arange(-beyond, KNOTS + beyond)
        since = at[..., None] - delay[:, None]  # (item, case, knot, motor)
        share = np.clip(since / np.maximum(duration, 1e-6)[..., None, :], 0.0, 1.0)
        pose = origin[..., None, :] + share * (destination - origin)[..., None, :]
        return self.model.sensors.along(pose, step), longest + 2 * beyond * step, beyond * step


def log_density_on_way(
    point: FloatArray,
    predicted: Sequence[FloatArray],
    velocity: Sequence[FloatArray],
    variance: FloatArray,
    step_s: float,
    sensors: SensorStack,
) -> FloatArray:
    """Return the log density of readings, the doubt of their time along the way, (...).

    Args:
        point: Readings, (..., channel) [m].
        predicted: Where each channel is expected, (...) [m].
        velocity: How fast it changes there, (...) [m/s].
        variance: Of a reading on each channel, (...) [m2].
        step_s: How coarsely the start of the movement is known [s].
        sensors: What is believed.
    """
    error = [point[..., axis] - predicted[axis] for axis in range(len(predicted))]
    speed2 = sum(v * v for v in velocity)
    along2 = sum(e * v for e, v in zip(error, velocity, strict=True)) ** 2
    along2 /= np.maximum(speed2, 1e-12)
    error2 = sum(e * e for e in error)
    stretched = variance + speed2 * (JITTER_S**2 + step_s**2 / 12.0)
    square = np.maximum(error2 - along2, 0.0) / variance + along2 / stretched
    log_at = log_fall(square, DOF, sensors.dims_on_way) - 0.5 * np.log(stretched)
    log_at += log_norm(DOF, sensors.dims_on_way) - 0.5 * (len(error) - 1) * np.log(variance)
    log_at += np.log1p(-GLITCH_RATE)
    across = 0.5 * (sensors.channels_on_way - sensors.dims_on_way)
    anywhere = sensors.log_anywhere_on_way - across * np.log(variance)
    return np.logaddexp(log_at, np.log(GLITCH_RATE) + anywhere)
