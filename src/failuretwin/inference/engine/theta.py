"""Theta: what all moments of a robot share and nobody knows exactly.

    f = G theta
    G = [ I | -[x]x | x | J | J diag(g) | -J diag(d) | dx/dgeometry | -J diag(qd) | J o ]

with origin t [m], turn w [rad] and scale k [-] of the tool sensor's frame, bias b [rad], compliance
c [rad/(N m)] and friction f [rad] of each motor, the frames of the joints, each moved [m] and
turned [rad], and, of robots that are seen on the way, the lag of each motor [s] beside the mean one
of the robot, and by which share of the bend o of a command (`on_the_way`) its motors are off,
beside the mean one. The prior is a mixture of normal distributions.

Section: docs/inference.md#theta
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.numerics import log_of
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, loads_in_range
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.registered import REGISTRATION

ORIGIN_M, TURN_RAD = 0.003, 0.005
"""Deviations by which the frame of a joint stands off its URDF [m, rad]: a real UR10 is 1.2 mm off,
a 7-joint cable-driven arm 3.3 mm, at the median; assumed for all arms."""
KNOWN = 1e-6
"""Deviation that stands for "known" in each unit of theta."""
LEAST_SCATTER_RAD = 1e-4
"""Scatter beside which doubts of offsets are judged, at least [rad]."""
BEND_SPREAD = 0.5
"""Deviation of the share of `Stretches.bend` by which motors are off; assumed."""
ODD_RATE, ODD_FACTOR = 0.1, 3.0
"""Share of robots whose offsets differ more than those of others of their kind, and how many times
as far; assumed."""
SOFT_RATE, SOFT_FACTOR = 0.1, 8.0
"""Share of odd robots, seen on the way and calibrated by nobody, that may sag further, and how many
times as far as usual ones: the P gain of a servo is a setting. That of an STS3215 is 32 as sold,
and 4 in logs of a healthy one (kscalelabs/sysid)."""


@dataclass(frozen=True)
class Layout:
    """Places in theta.

    Attributes:
        motors: Number of motors.
        geometry: Whether the frames of the joints are unknown.
        moving: Whether moments on the way tell of lags and bends.
    """

    motors: int
    geometry: bool
    moving: bool = False

    @property
    def offsets(self) -> slice:
        """Places of bias, compliance and friction."""
        return slice(REGISTRATION, REGISTRATION + 3 * self.motors)

    @property
    def frames(self) -> slice:
        """Places of the joint frames."""
        return slice(self.offsets.stop, self.offsets.stop + 6 * self.motors * self.geometry)

    @property
    def lags(self) -> slice:
        """Places of the lags."""
        return slice(self.frames.stop, self.frames.stop + self.motors * self.moving)

    @property
    def bend(self) -> slice:
        """Place of the share of bends."""
        return slice(self.lags.stop, self.lags.stop + self.moving)

    @property
    def size(self) -> int:
        """Length of theta."""
        return self.bend.stop

    def place(self, theta: FloatArray) -> FloatArray:
        """Return where theta is expanded: registration, offsets and lags of it, all else at 0."""
        at = np.arange(len(theta))
        lags = (at >= self.lags.start) & (at < self.lags.stop)
        return np.where((at < self.offsets.stop) | lags, theta, 0.0)

    def zeros(self, covariance: FloatArray) -> FloatArray:
        """Return the deviation of the zero of each motor, of bias and joint frame, (motor,) [rad].

        Args:
            covariance: V, (theta, theta).
        """
        variance = np.diag(covariance)
        turned = variance[self.frames].reshape(-1, 2, 3)[:, 1].max(axis=1) if self.geometry else 0.0
        return np.asarray(np.sqrt(variance[self.offsets][: self.motors] + turned))

    def own(self, motor: int) -> list[int]:
        """Return the places of one motor's bias, compliance and friction."""
        return [REGISTRATION + motor + self.motors * k for k in range(3)]


@dataclass(frozen=True)
class Components:
    """Beliefs about the robot: theta normal in each, with its scatter and its sensor.

    Components that differ in scatter, jitter or noise alone share a normal distribution of theta.

    Attributes:
        log_weight: Log of the probability of each, (component,) or (run, component).
        normal: Which normal distribution of theta is that of each, (component,).
        mean: mu, (normal, theta) or of each run, (run, normal, theta).
        covariance: V, (normal, theta, theta) or (run, normal, theta, theta).
        sigma: Factor on the scatter of the motors, (component,).
        jitter: Factor on the deviation of when motors start, (component,).
        noise_m: Noise of the sensor, (component,) [m].
        displaced: Whether the sensor stands elsewhere than the profile says, (component,).
        lossy: Share of robots that lose commands `moments.LOSSY` times as often, in each component.
    """

    log_weight: FloatArray
    normal: IntArray
    mean: FloatArray
    covariance: FloatArray
    sigma: FloatArray
    jitter: FloatArray
    noise_m: FloatArray
    displaced: BoolArray
    lossy: float = 0.0

    @classmethod
    def normal_of(
        cls, covariance: FloatArray, noise_m: float, displaced: bool = False
    ) -> Components:
        """Return one normal distribution about 0 of a robot that scatters as its class.

        Args:
            covariance: V, (theta, theta).
            noise_m: Noise of the sensor [m].
            displaced: Whether the sensor stands elsewhere than the profile says.
        """
        none = np.zeros(1)
        return cls(
            none,
            np.zeros(1, dtype=np.int64),
            np.zeros((1, len(covariance))),
            covariance[None],
            np.ones(1),
            np.ones(1),
            np.array([noise_m]),
            np.array([displaced]),
        )

    def __len__(self) -> int:
        """How many."""
        return len(self.sigma)

    def of_runs(self, rows: IntArray) -> Components:
        """Return what is believed of the robots of some runs."""
        return replace(
            self,
            log_weight=self.log_weight[rows] if self.log_weight.ndim == 2 else self.log_weight,
            mean=self.mean[rows] if self.mean.ndim == 3 else self.mean,
            covariance=self.covariance[rows] if self.covariance.ndim == 4 else self.covariance,
        )

    @property
    def unknown(self) -> IntArray:
        """Places in theta that are not known in every component, (place,)."""
        return np.flatnonzero((self.widest**2 > 2.0 * KNOWN**2) | self._moved)

    @property
    def _moved(self) -> BoolArray:
        """Places in theta whose mean is not 0 everywhere, (theta,)."""
        return np.asarray((self.mean != 0.0).reshape(-1, self.mean.shape[-1]).any(axis=0))

    @property
    def usual(self) -> FloatArray:
        """V of the first normal distribution, of the first run if they have their own."""
        return self.covariance.reshape(-1, *self.covariance.shape[-2:])[0]

    @property
    def usual_deviation(self) -> FloatArray:
        """Deviation of each part of theta in that distribution, (theta,)."""
        return np.asarray(np.sqrt(np.diag(self.usual)))

    @property
    def widest(self) -> FloatArray:
        """Largest deviation of each part of theta, (theta,)."""
        variance = np.diagonal(self.covariance, axis1=-2, axis2=-1)
        return np.sqrt(variance.reshape(-1, variance.shape[-1]).max(axis=0))

    @property
    def first(self) -> Components:
        """The first one alone."""
        return Components.normal_of(self.covariance[0], float(self.noise_m[0]))

    @property
    def normals(self) -> int:
        """How many normal distributions of theta."""
        return self.mean.shape[-2]

    def theta(self, run: IntArray, normal: IntArray | int) -> tuple[FloatArray, FloatArray]:
        """Return V and mu of some normal distributions in some runs, (pick, ...)."""
        normal = np.broadcast_to(normal, run.shape)
        mean = self.mean[normal] if self.mean.ndim == 2 else self.mean[run, normal]
        shared = self.covariance.ndim == 3
        return self.covariance[normal] if shared else self.covariance[run, normal], mean

    def about(self, place: FloatArray) -> Components:
        """Return the same for runs that are expanded about some theta each, (run, theta)."""
        return replace(self, mean=self.mean - place[:, None])

    def weighted(self, rate: float) -> Components:
        """Return the same with a probability that one of them is true."""
        return replace(self, log_weight=self.log_weight + float(log_of(rate)))

    @classmethod
    def joined(cls, parts: Sequence[Components]) -> Components:
        """Return several beliefs as one; means are those of all runs or of each in all of them."""
        begin = np.cumsum([0, *(one.normals for one in parts[:-1])])
        normal = [one.normal + at for one, at in zip(parts, begin, strict=True)]
        return cls(
            np.concatenate([one.log_weight for one in parts], axis=-1),
            np.concatenate(normal),
            np.concatenate([one.mean for one in parts], axis=-2),
            np.concatenate([one.covariance for one in parts], axis=-3),
            np.concatenate([one.sigma for one in parts]),
            np.concatenate([one.jitter for one in parts]),
            np.concatenate([one.noise_m for one in parts]),
            np.concatenate([one.displaced for one in parts]),
            max(one.lossy for one in parts),
        )

    def weight(self, run: IntArray, component: IntArray) -> FloatArray:
        """Return the log weight of some components in some runs, (pick,)."""
        if self.log_weight.ndim == 1:
            return self.log_weight[component]
        return self.log_weight[run, component]


@dataclass(frozen=True)
class Motion:
    """How motors move, (..., motor) each.

    Attributes:
        direction: Sign of the last travel.
        speed: [rad/s].
        bend: What a usual first-order lag makes of the command beside a delay [rad].
    """

    direction: FloatArray
    speed: FloatArray
    bend: FloatArray


Shown = tuple[FloatArray, FloatArray]
"""What sensors show of poses, (..., channel) [m], and J, (..., channel, motor) [m/rad]."""


def columns(
    model: HealthyModel, pose: FloatArray, shown: Shown, motion: Motion, layout: Layout
) -> FloatArray:
    """Return G at some poses, (..., channel, theta).

    Args:
        model: The healthy robot.
        pose: Settled angles, (..., motor) [rad].
        shown: What the sensors show there.
        motion: How the motors move there.
        layout: Places in theta.
    """
    value, jacobian = shown
    found = np.zeros((*value.shape, layout.size))
    own = model.sensors.registered
    if own is not None:
        x = value[..., own]
        for axis, (left, right) in enumerate(((1, 2), (2, 0), (0, 1))):
            found[..., own.start + axis, axis] = 1.0
            found[..., own.start + right, 3 + axis] = x[..., left]
            found[..., own.start + left, 3 + axis] = -x[..., right]
        found[..., own, 6] = x
    load = loads(model, pose)[..., None, :]
    parts = [jacobian, jacobian * load, -jacobian * motion.direction[..., None, :]]
    if layout.geometry:
        parts.append(model.twin.geometry_columns(pose))
    if layout.moving:
        parts.append(-jacobian * motion.speed[..., None, :])
        parts.append(jacobian @ motion.bend[..., None])
    np.concatenate(parts, axis=-1, out=found[..., REGISTRATION:])
    return found


def has_geometry(model: HealthyModel) -> bool:
    """Return whether joint frames are in doubt.

    They do not show where the path is computed from motor readings. What they leave of a robot that
    was calibrated, or whose geometry was fitted, is in the scatter and the noise that were found,
    unless these were found beside them.
    """
    shows = model.sensors.tool_alone and model.twin.robot.profile.sensor_pose != "log"
    return shows and (not model.is_calibrated or model.imperfections.frames_in_doubt)


def layout_of(model: HealthyModel, moving: bool = False) -> Layout:
    """Return what is unknown of a robot.

    Args:
        model: The healthy robot.
        moving: Whether it is seen on the way.
    """
    return Layout(len(model.scatter), has_geometry(model), moving)


@dataclass(frozen=True)
class ScaleFactors:
    """Factors on scatter, noise and jitter with the share of robots of each, and lossy robots.

    Attributes:
        scatter: On the scatter of the motors.
        noise: On the noise of the sensor.
        jitter: On the deviation of when motors start, of robots that are seen on the way.
        lossy: Share of robots that lose commands `moments.LOSSY` times as often.
    """

    scatter: Mapping[float, float]
    noise: Mapping[float, float]
    jitter: Mapping[float, float]
    lossy: float = 0.0


JITTER = {1.0: 0.4, 0.4: 0.4, 2.5: 0.2}
"""Factors on how unevenly motors start, and the share of robots of each; assumed."""
AS_TOLD = ScaleFactors({1.0: 1.0}, {1.0: 1.0}, {1.0: 1.0})
"""Scatter and noise are known."""
OF_CLASS = ScaleFactors(
    {0.5: 0.25, 1.0: 0.4, 2.0: 0.2, 4.0: 0.1, 9.0: 0.05},
    {0.1: 0.2, 0.3: 0.15, 1.0: 0.5, 3.0: 0.1, 8.0: 0.05},
    JITTER,
    lossy=0.15,
)
"""Of robots that nobody has calibrated; assumed, heavy above 1."""
SINCE_CALIBRATED = ScaleFactors(
    {1.0: 0.72, 1.6: 0.14, 2.5: 0.1, 4.0: 0.04}, {1.0: 0.92, 3.0: 0.05, 8.0: 0.03}, JITTER
)
"""Of calibrated robots, which wear, work at other speeds or stand elsewhere since; assumed."""


def robot_components(model: HealthyModel, layout: Layout, factors: ScaleFactors) -> Components:
    """Return what is believed of a robot whose sensor is where the profile says.

    The first is the usual robot of the class. One whose offsets are odd scatters as usual.

    Args:
        model: The healthy robot.
        layout: Places in theta.
        factors: What is unknown of its scatter, of the noise of its sensor and of its starts.
    """
    doubted = bool(np.any(offset_deviation(model)))
    odd = [(ODD_RATE, _covariance(model, layout, ODD_FACTOR))] if doubted else []
    if doubted and layout.moving and model.imperfections.of_class:
        odd.append((SOFT_RATE, _soft(model, layout, odd[0][1])))
    rate = sum(share for share, _ in odd)
    starts = (factors.jitter if layout.moving else AS_TOLD.jitter).items()
    sensors = [((tau, kappa), a * b) for tau, a in starts for kappa, b in factors.noise.items()]
    found = [
        (a * b * (1.0 - rate), 0, sigma, *others)
        for sigma, a in factors.scatter.items()
        for others, b in sensors
    ]
    for at, (share, _) in enumerate(odd, start=1):
        found += [(b * share, at, 1.0, *others) for others, b in sensors]
    found.sort(key=lambda one: -one[0])
    weight, normal, sigma, tau, kappa = zip(*found, strict=True)
    covariance = np.stack([_covariance(model, layout, 1.0), *(one for _, one in odd)])
    return Components(
        np.log(weight),
        np.array(normal),
        np.zeros((len(covariance), layout.size)),
        covariance,
        np.array(sigma),
        np.array(tau),
        model.path_noise * np.array(kappa),
        np.zeros(len(sigma), dtype=bool),
        factors.lossy,
    )


def _covariance(model: HealthyModel, layout: Layout, factor: float) -> FloatArray:
    motors = layout.motors
    deviation = np.full(layout.size, KNOWN)
    constant, turned = model.sensors.deviations
    deviation[:3], deviation[3:6] = max(constant, KNOWN), max(turned, KNOWN)
    deviation[layout.offsets] = np.maximum(factor * offset_deviation(model), KNOWN)
    if layout.geometry:
        deviation[layout.frames] = factor * frame_deviation(model.twin.robot)
    covariance = np.diag(deviation**2)
    if layout.moving:
        common, own = model.lag_deviations_s
        covariance[layout.lags, layout.lags] = common**2 + own**2 * np.eye(motors)
        covariance[layout.bend, layout.bend] = BEND_SPREAD**2
    return covariance


def _soft(model: HealthyModel, layout: Layout, odd: FloatArray) -> FloatArray:
    """Return the covariance of an odd robot whose motors may give way much further."""
    found, places = odd.copy(), np.arange(layout.offsets.start, layout.offsets.stop)
    sag = places[layout.motors : 2 * layout.motors]
    soft = (SOFT_FACTOR * np.asarray(model.settling.compliance)) ** 2
    found[sag, sag] = np.maximum(found[sag, sag], soft)
    return found


def frame_deviation(robot: Robot) -> FloatArray:
    """Return the deviation of the joint frames, (6 joint,) [m, rad]."""
    return np.tile([ORIGIN_M] * 3 + [TURN_RAD] * 3, len(robot.motors))


# What is in doubt of the offsets of a robot.

SMALL_DOUBT = 0.5
"""Doubt of an offset below this share of its motor's scatter moves no posterior by a hundredth
[-]."""


def loads(model: HealthyModel, pose: FloatArray) -> FloatArray:
    """Return g, by how much each motor gives way for each unit of compliance, (..., motor) [N m].

    Args:
        model: The healthy robot.
        pose: Angles that the motors settle near, (..., motor) [rad].
    """
    robot = model.twin.robot
    return np.asarray(robot.sense * robot.loads.torque(pose * robot.sense, model.settling.payload))


def offsets_doubted(model: HealthyModel) -> bool:
    """Return whether a calibration leaves much of the offsets open, so that runs can teach them."""
    motors, deviation = len(model.scatter), offset_deviation(model)
    scatter = np.maximum(np.asarray(model.settling.scatter), LEAST_SCATTER_RAD)
    large = deviation[:motors] > SMALL_DOUBT * scatter
    large |= deviation[2 * motors :] > SMALL_DOUBT * scatter
    large |= deviation[motors : 2 * motors] * typical_load(model) > SMALL_DOUBT * scatter
    return bool(large.any())


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


def offsets_of(theta: FloatArray, settling: Settling) -> Settling:
    """Return where motors settle with the offsets of theta beside those that are known.

    Args:
        theta: With the layout of `Layout`, (theta,).
        settling: What is known.
    """
    offsets = theta[Layout(len(settling.scatter), geometry=False).offsets]
    bias, compliance, friction = offsets.reshape(3, -1)
    return replace(
        settling,
        bias=tuple((np.asarray(settling.bias) + bias).tolist()),
        compliance=tuple((np.asarray(settling.compliance) + compliance).tolist()),
        friction=tuple((np.asarray(settling.friction) + friction).tolist()),
    )
