"""Signals of simulated runs: drive of the motors, tool path, readings of other sensors.

A sensor beside that of the tool's position reads

    y seen = y(q(t)) + b + n,    b ~ N(bias, doubt^2) of each run,    n ~ N(0, noise^2) of a reading

Section: docs/sensors.md
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.disturbances import (
    Disturbances,
    actual_movements,
    draw_disturbances,
    lagged,
    stack,
)
from failuretwin.digital_model.nonidealities import Imperfections, deterministic
from failuretwin.digital_model.profile import KINDS
from failuretwin.digital_model.sensors import sensor_of
from failuretwin.digital_model.twin import DigitalTwin, Drive, ServoEngine
from failuretwin.failure_behavior.injection import Injection

SIMULATED = tuple(kind for kind in KINDS if kind != "encoders")
"""Sensors that are simulated when they are asked for; readings of the motors always are."""


def drive_of(
    commanded: Movements,
    time: FloatArray,
    injection: Injection,
    chance: Disturbances,
) -> Drive:
    """Return the references and faults that drive the motors of some runs on a grid (time,) [s]."""
    faulty, lost = injection.on_movements(commanded, chance.lost)
    actual = actual_movements(faulty, replace(chance, lost=lost))
    followed = lagged(actual.reference(time), time, chance.lag)
    return Drive(
        reference=injection.on_reference(followed, time),
        held=injection.held(time),
        weakness=injection.weakness(time),
        compliance=chance.compliance if chance.compliance.any() else None,
        payload=chance.payload if chance.payload.any() else None,
    )


def noise_free_path(
    twin: DigitalTwin,
    imperfections: Imperfections,
    movements: Movements,
    time: FloatArray,
    injection: Injection,
) -> FloatArray:
    """Return the path of the tool with faults, and without scatter, losses, stalls and glitches.

    `time` is a uniform grid, (time,) [s].

    Returns:
        (run, time, axis) [m].
    """
    runs, count = movements.start.shape
    rng = np.random.default_rng(0)  # asked, but nothing that it says counts
    luck = draw_disturbances(deterministic(imperfections), twin.robot, count, 0.0, rng)
    drive = drive_of(movements, time, injection, stack([luck] * runs))
    return twin.path(ServoEngine(twin.robot).angles(drive, time))


def simulated_sensors(
    kinds: Sequence[str],
    twin: DigitalTwin,
    imperfections: Imperfections,
    position: FloatArray,
    seen: BoolArray,
    step_s: float,
    seeds: Sequence[Sequence[int]],
) -> dict[str, FloatArray]:
    """Return what sensors read, by variable of a run set, (run, time, ...).

    They are read when the tool is. Chance of their own leaves all other chance as it was.

    Args:
        kinds: The sensors.
        twin: Kinematics.
        imperfections: May say what the sensors are like; else the profile, else as usual.
        position: True angles, (run, time, motor) [rad].
        seen: When the tool is read, (run, time).
        step_s: Step of the grid [s].
        seeds: Seed of each run.
    """
    found = {}
    for kind in kinds:
        sensor = sensor_of(kind, twin, imperfections.sensors, twin.robot.profile.sensors)
        true = sensor.along(position, np.full(len(position), step_s))
        values = []
        for channels, seed in zip(true, seeds, strict=True):
            rng = np.random.default_rng([*seed, KINDS.index(kind)])
            turn = Rotation.from_rotvec(rng.normal(0.0, 1.0, 3) * sensor.turn_doubt).as_matrix()
            constant = rng.normal(0.0, 1.0, sensor.dims) * sensor.doubt
            noise = rng.normal(0.0, sensor.noise, (position.shape[1], sensor.dims))
            turned = channels @ turn.T if sensor.turn_doubt else channels
            values.append(sensor.with_errors(turned, constant + noise))
        found[sensor.variable] = np.stack(values)
        found[sensor.variable][~seen] = np.nan
    return found
