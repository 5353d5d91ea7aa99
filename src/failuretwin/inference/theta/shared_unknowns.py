"""What all movements of a run share and nobody has measured exactly: registration and offsets.

    x_seen = (1 + k) R(w) x + t,    angle = base + b + c g - f d
    theta = (t, w, k, b, c, f)

with origin t [m], turn w [rad] and scale k of the tool sensor's frame about the robot's base frame,
and bias b, compliance c and friction f of each motor beside those of the healthy model; g are load
torques and d directions of travel. `engine.theta` has the columns of theta.

Section: docs/inference.md#shared-unknowns
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from failuretwin.core.numerics import log_of
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.settling import Settling, loads_in_range
from failuretwin.inference.observation.evidence import SettledEvidence, TransientSamples
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.sensors import SensorStack
from failuretwin.inference.set_ups.setup_prior import SetupPrior

ORIGIN, TURN, SCALE = slice(0, 3), slice(3, 6), slice(6, 7)
"""Places of t [m], w [rad] and k [-] in theta."""
REGISTRATION = 7
"""How many of theta are registration; the offsets of the motors follow."""
KNOWN = 1e-4
"""Deviation that stands for "known", as a share of the unit of each part of theta."""


@dataclass(frozen=True)
class SharedLayout:
    """What stands where in theta.

    Attributes:
        motors: How many motors the robot has.
        offsets: Whether their offsets are in doubt; otherwise theta is the registration alone.
    """

    motors: int
    offsets: bool

    @property
    def size(self) -> int:
        """Length of theta."""
        return REGISTRATION + 3 * self.motors * self.offsets


def loads(model: HealthyModel, pose: FloatArray) -> FloatArray:
    """Return g, by how much each motor gives way for each unit of compliance, (..., motor) [N m].

    Args:
        model: The healthy robot.
        pose: Angles that the motors settle near, (..., motor) [rad].
    """
    robot = model.twin.robot
    return np.asarray(robot.sense * robot.loads.torque(pose * robot.sense, model.settling.payload))


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


# What is believed of theta before a run is seen: a mixture of normal distributions about the model.


@dataclass(frozen=True)
class SharedComponent:
    """One normal distribution of theta about the healthy model.

    Attributes:
        name: What it stands for.
        log_weight: Log of its probability.
        deviation: Standard deviation of each part of theta, (theta,).
        noise_m: Noise of the sensor beside what is known of it [m].
    """

    name: str
    log_weight: float
    deviation: FloatArray
    noise_m: float = 0.0


ODD_RATE, ODD_FACTOR = 0.1, 3.0
"""Share of robots whose offsets differ more than others of their kind, and how many times as far:
tails of what a population is like; assumed."""
SMALL_DOUBT = 0.5
"""Doubt of an offset below this share of its motor's scatter counts as scatter: it moves no
posterior by a hundredth [-]."""


def layout_of(model: HealthyModel) -> SharedLayout:
    """Return what is in doubt of a robot: its offsets where a calibration leaves much of them."""
    motors, deviation = len(model.scatter), offset_deviation(model)
    scatter = np.maximum(np.asarray(model.settling.scatter), KNOWN)
    large = deviation[:motors] > SMALL_DOUBT * scatter
    large |= deviation[2 * motors :] > SMALL_DOUBT * scatter
    large |= deviation[motors : 2 * motors] * typical_load(model) > SMALL_DOUBT * scatter
    return SharedLayout(motors, bool(large.any()))


def typical_load(model: HealthyModel) -> FloatArray:
    """Return the rms load torque of each motor over its range, (motor,) [N m]."""
    load = loads_in_range(model.twin.robot, model.settling.payload)
    return np.sqrt(np.mean(load**2, axis=0))


def offset_deviation(model: HealthyModel) -> FloatArray:
    """Return the standard deviation of b, c and f that is left of a robot, (3 motor,)."""
    motors, doubt = len(model.scatter), model.imperfections.variation
    if doubt is None:
        return np.zeros(3 * motors)
    compliance = np.asarray(model.settling.compliance) * np.asarray(doubt.compliance or 0.0)
    parts = (np.asarray(doubt.bias or 0.0), compliance, np.asarray(doubt.friction or 0.0))
    return np.concatenate([np.broadcast_to(part, motors) for part in parts])


def components(
    model: HealthyModel, prior: SetupPrior, layout: SharedLayout
) -> list[SharedComponent]:
    """Return what is believed of theta beside the healthy model; the first is that all is well.

    What is impossible is left out.

    Args:
        model: The healthy robot; its doubt is that of the offsets in every component.
        prior: How far set-ups may be off.
        layout: What stands in theta.
    """
    reach, motors = model.twin.robot.reach, layout.motors
    least = np.full(3 * motors, KNOWN * 0.01)
    least[motors : 2 * motors] /= np.maximum(typical_load(model), 1e-3)
    offsets = np.maximum(offset_deviation(model), least)[: layout.size - REGISTRATION]
    known = np.concatenate([np.full(3, KNOWN * 0.003 * reach), np.full(4, KNOWN * 0.003), offsets])
    constant, turned = model.sensors.deviations
    known[ORIGIN] = np.maximum(known[ORIGIN], constant)
    known[TURN] = np.maximum(known[TURN], turned)

    def off(name: str, rate: float, origin: float, turn: float, scale: float) -> SharedComponent:
        deviation = known.copy()
        for place, value in ((ORIGIN, origin * reach), (TURN, turn), (SCALE, scale)):
            deviation[place] = np.maximum(deviation[place], value)
        return SharedComponent(name, float(log_of(rate)), deviation)

    near, far = prior.origin
    little, much = prior.turn_rad
    found = [SharedComponent("", float(np.log1p(-prior.doubt)), known)]
    if layout.offsets:
        odd = known.copy()
        odd[REGISTRATION:] *= ODD_FACTOR
        usual = found[0].log_weight + float(np.log1p(-ODD_RATE))
        found = [replace(found[0], log_weight=usual)]
        found.append(SharedComponent("", usual + float(np.log(ODD_RATE / (1 - ODD_RATE))), odd))
    found += [off("origin", prior.origin_rate / 2, o, 0.0, 0.0) for o in (near, far)]
    found += [off("turn", prior.turn_rate / 2, 0.0, w, 0.0) for w in (little, much)]
    found.append(off("scale", prior.scale_rate, 0.0, 0.0, prior.scale))
    found.append(off("frame", prior.all_rate, (near + far) / 2, (little + much) / 2, prior.scale))
    noise = float(log_of(prior.noise_rate / 2))
    found += [SharedComponent("noise", noise, known, share * reach) for share in prior.noise]
    return [part for part in found if np.isfinite(part.log_weight)]


def offsets_of(theta: FloatArray, settling: Settling) -> Settling:
    """Return where motors settle with the offsets of theta beside those that are known.

    Args:
        theta: Shared unknowns with offsets, (theta,).
        settling: What is known.
    """
    bias, compliance, friction = theta[REGISTRATION:].reshape(3, -1)
    return replace(
        settling,
        bias=tuple((np.asarray(settling.bias) + bias).tolist()),
        compliance=tuple((np.asarray(settling.compliance) + compliance).tolist()),
        friction=tuple((np.asarray(settling.friction) + friction).tolist()),
    )
