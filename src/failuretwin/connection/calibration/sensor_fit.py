"""What healthy runs teach of sensors beside that of the tool's position: constant error and noise.

    y seen = y(q) + b + w x y(q) + J dq + n,    b ~ N(0, far^2),  w ~ N(0, turn_doubt^2)

with q where healthy motors settle, their scatter dq and the noise n of a reading; robustly, each
movement weighed by a Student t. Noise is how readings scatter about their mean at rest. How the
sensor is turned on its mount, w, is asked only where the profile says that it is in doubt.

Section: docs/sensors.md#sensors-in-the-profile
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from failuretwin.connection.calibration.result import Parameter
from failuretwin.connection.student_fit import fit_student
from failuretwin.core.movements import find_movements
from failuretwin.core.numerics import Covariance
from failuretwin.core.runs import RunSet
from failuretwin.core.types import BoolArray, FloatArray, as_floats
from failuretwin.digital_model.profile import SensorProfile
from failuretwin.digital_model.sensors import SENSORS, Encoders, Sensor, Tool, sensor_of
from failuretwin.inference.observation.evidence import rest_begin
from failuretwin.inference.observation.healthy_model import HealthyModel

FAR = 20.0
"""A constant error is looked for within so many times its usual doubt, or its noise."""
LEAST_MOVEMENTS = 5
"""Fewer settled movements say nothing of a sensor."""
RESTLESS = 4.0
"""A window whose readings scatter by so many times the usual is no rest."""


@dataclass(frozen=True)
class SensorFit:
    """What runs say of a sensor.

    Attributes:
        profile: The sensor as it is now known.
        movements: Settled movements that it rests on.
        parameters: Its figures, with their 95 % intervals.
    """

    profile: SensorProfile
    movements: int
    parameters: tuple[Parameter, ...]


def fit_sensors(runs: RunSet, model: HealthyModel) -> tuple[SensorFit, ...]:
    """Return what healthy runs say of every sensor whose readings they hold.

    Of the tool's position and of the motors' own readings nothing is learned here.
    """
    told = (model.imperfections.sensors, model.twin.robot.profile.sensors)
    fits = []
    for kind, of in SENSORS.items():
        if kind in (Tool.kind, Encoders.kind) or of.variable not in runs:
            continue
        fit = _fit(runs, model, sensor_of(kind, model.twin, *told))
        if fit is not None:
            fits.append(fit)
    return tuple(fits)


def _fit(runs: RunSet, model: HealthyModel, sensor: Sensor) -> SensorFit | None:
    before = sensor.profile or SensorProfile(sensor.kind)
    plain = type(sensor)(sensor.twin, replace(before, bias=()))
    seen, pose, noise, noise_sd = _at_rest(runs, model, plain)
    if len(seen) < LEAST_MOVEMENTS:
        return None
    value, jacobian = plain.expected(pose)
    turns = before.turn_doubt > 0.0 and plain.dims == plain.channels == 3
    errors = plain.dims
    far = FAR * max(plain.usual_doubt, noise)
    prior = np.concatenate([np.full(errors, far), np.full(3 * turns, before.turn_doubt)])
    white = Covariance.of(jacobian * model.scatter, noise**2, errors).inverse_root

    def residual(x: FloatArray) -> FloatArray:
        error, turn = np.split(x * prior, [errors])
        shown = plain.to_channels(plain.with_errors(value, np.tile(error, (len(seen), 1))))
        shown = shown + np.cross(turn, value) if turns else shown
        return np.asarray(np.einsum("mij,mj->mi", white, seen - shown))

    told = fit_student(residual, np.zeros(len(prior)), errors)
    estimate, deviation = told.value * prior, np.sqrt(np.diag(told.covariance)) * prior
    bias, turn = estimate[:errors], estimate[errors:]
    mount = Rotation.from_euler("xyz", before.rpy)
    if turns:
        mount = mount * Rotation.from_rotvec(turn).inv()
    roll, pitch, yaw = mount.as_euler("xyz")
    found = replace(
        before,
        noise=float(noise),
        bias=tuple(float(b) for b in bias),
        doubt=float(deviation[:errors].max()),
        turn_doubt=float(deviation[errors:].max(initial=0.0)),
        rpy=(float(roll), float(pitch), float(yaw)) if turns else before.rpy,
    )
    return SensorFit(found, len(seen), _parameters(plain, estimate, deviation, (noise, noise_sd)))


def _at_rest(
    runs: RunSet, model: HealthyModel, sensor: Sensor
) -> tuple[FloatArray, FloatArray, float, float]:
    """Return settled channels (movement, channel), healthy poses (movement, motor), noise.

    Last the standard deviation of the noise, that of a median of so many stretches at rest.
    """
    time = as_floats(runs["time"].values)
    movements = find_movements(as_floats(runs["command"].values), time)
    channels = sensor.to_channels(as_floats(runs[sensor.variable].values))
    end = np.full_like(movements.start, time[-1])
    end[:, :-1] = np.fmin(movements.start[:, 1:], time[-1])
    begin = rest_begin(movements.start, movements.ramp_duration, end)
    usual = model.outcomes(movements)
    poses = model.settle(usual.base, usual.direction, model.none_held)[:, :, 0]
    points, spreads, at = [], [], []
    for run, number in np.argwhere(movements.exists):
        inside = (time >= begin[run, number]) & (time < end[run, number] - 1e-9)
        values = channels[run, inside]
        values = values[np.isfinite(values).all(axis=1)]
        if len(values) > 2:
            points.append(np.median(values, axis=0))
            free = sensor.dims * (len(values) - 1)
            square = np.sum((values - values.mean(axis=0)) ** 2) / free
            spreads.append(square / (1.0 - 2.0 / (9.0 * free)) ** 3)  # the median of chi2 / free
            at.append(poses[run, number])
    if not points:
        return np.zeros((0, sensor.channels)), np.zeros((0, len(model.scatter))), 0.0, 0.0
    size = np.sqrt(spreads)
    still: BoolArray = size <= RESTLESS * np.median(size)
    noise = float(np.median(size[still]))
    doubt = float(MEDIAN_SPREAD * np.std(size[still]) / np.sqrt(still.sum()))
    return np.array(points)[still], np.array(at)[still], max(noise, 1e-9), doubt


def _parameters(
    sensor: Sensor, estimate: FloatArray, deviation: FloatArray, noise: tuple[float, float]
) -> tuple[Parameter, ...]:
    factor, unit = UNITS[sensor.kind]
    constant = [(f"constant error {k + 1}", factor, unit) for k in range(sensor.dims)]
    turns = [(f"turn {k + 1}", DEG, "deg") for k in range(len(estimate) - sensor.dims)]
    found = [
        Parameter.normal(f"{sensor.kind}: {name}", "", shown, scale * float(value), scale * sd)
        for (name, scale, shown), value, sd in zip(
            [*constant, *turns], estimate, deviation.tolist(), strict=True
        )
    ]
    size, doubt = (factor * value for value in noise)
    scatter = Parameter.normal(f"{sensor.kind}: noise", "", unit, size, doubt)
    return (*found, replace(scatter, low=max(scatter.low, 0.0)))


MEDIAN_SPREAD = float(np.sqrt(np.pi / 2.0))
"""Standard deviation of the median of many normal numbers, in that of their mean."""
DEG = float(np.rad2deg(1.0))
UNITS = {
    "orientation": (DEG, "deg"),
    "accelerometer": (1.0, "m/s2"),
    "gyroscope": (DEG, "deg/s"),
    "wire": (1e3, "mm"),
}
"""Unit in which each sensor's errors are told, and factor to it."""
