"""What a sensor has seen, registered: moved into the base frame of the robot.

    x_seen = (1 + k) R(w) x + t

with origin t [m], turn w [rad] and scale k [-] of the sensor's frame.

Section: docs/inference.md#shared-unknowns
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from failuretwin.core.types import FloatArray
from failuretwin.inference.observation.evidence import SettledEvidence, TransientSamples
from failuretwin.inference.observation.sensors import SensorStack

ORIGIN, TURN, SCALE = slice(0, 3), slice(3, 6), slice(6, 7)
"""Places of t, w and k in a registration."""
REGISTRATION = 7
"""Length of a registration."""


def registered(point: FloatArray, theta: FloatArray) -> FloatArray:
    """Return tool positions in the robot's base frame, x = R(w)^T (x_seen - t) / (1 + k).

    Args:
        point: Seen positions, (run, ..., 3) [m].
        theta: Registration of each run, (run, 7 or more).
    """
    turn = Rotation.from_rotvec(theta[:, TURN]).as_matrix()
    lead = (len(theta), *(1,) * (point.ndim - 2), -1)
    shifted = point - theta[:, ORIGIN].reshape(lead)
    scale = 1.0 + theta[:, SCALE].reshape(lead)
    return np.asarray(np.einsum("rji,r...j->r...i", turn, shifted) / scale)


def registered_evidence(
    evidence: SettledEvidence, theta: FloatArray, sensors: SensorStack | None = None
) -> SettledEvidence:
    """Return settled positions as the model has them; `theta` as for `registered`.

    Args:
        evidence: Settled positions.
        theta: Registration of each run, (run, 7 or more).
        sensors: What is believed; None: the tool's position alone.
    """
    own = slice(None) if sensors is None else sensors.registered
    return replace(evidence, point=_registered(evidence.point, theta, own))


def registered_samples(
    samples: TransientSamples, theta: FloatArray, sensors: SensorStack | None = None
) -> TransientSamples:
    """Return readings on the way as the model has them; see `registered_evidence`."""
    if sensors is None:
        return replace(samples, point=registered(samples.point, theta))
    there = theta.copy()
    there[:, ORIGIN] *= sensors.unit_on_way
    return replace(samples, point=_registered(samples.point, there, sensors.registered))


def _registered(point: FloatArray, theta: FloatArray, own: slice | None) -> FloatArray:
    """Return channels with those of the sensor that theta is of registered."""
    if own is None:
        return point
    found = point.copy()
    found[..., own] = registered(point[..., own], theta)
    return found
