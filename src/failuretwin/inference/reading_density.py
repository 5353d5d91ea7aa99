"""The density of a single reading on the way: near where it is expected, or anywhere.

    p(y) = (1 - eps) t_4(y - y(t); v I + speed^2 (jitter^2 + step^2 / 12) along the way) + eps / V

Section: docs/diagnosis.md#transient-likelihood-readings-on-the-way
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from failuretwin.core.numerics import log_fall, log_norm
from failuretwin.core.types import FloatArray
from failuretwin.inference.sensors import SensorStack

JITTER_S = 0.012
"""Standard deviation of the stamps of single readings [s], on top of the shared lag."""
DOF = 4.0
"""Degrees of freedom of single readings: heavy tails."""
GLITCH_RATE = 0.03
"""Share of readings that may be anywhere within reach [-]."""


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
