"""Classes of arms: priors of an uncalibrated robot.

Means go into `Settling`, differences between arms of a class into `Variation`, which is constant
for one robot. Sag follows from the masses of the URDF: the yielding of a motor under its own rms
load.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from failuretwin.core.config import AtLeastZero, Bounded, Share
from failuretwin.core.errors import unknown_name
from failuretwin.digital_model.nonidealities import (
    Imperfections,
    LostCommand,
    Variation,
)
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, loads_in_range

GENERIC_NAME = "generic, not calibrated"
"""Name of the healthy behaviour in results of an uncalibrated robot."""


@dataclass(frozen=True)
class ArmClass(Bounded):
    """Typical values of a class of arms, the same for every motor, and their spread.

    Attributes:
        bias_rad: Deviation of a motor's constant error [rad].
        session_rad: Deviation of that error of one arm from day to day [rad].
        sag_rad: Yielding under the rms load of a motor, mean and deviation alike [rad].
        friction_rad: Distance by which a motor stops short, mean [rad].
        friction_spread_rad: Deviation of that [rad].
        scatter_rad: Scale of the random error from movement to movement [rad].
        tail_dof: Degrees of freedom of that scatter.
        lost: Share of movements in which one given motor misses its command [-].
        lost_together: The same of two given motors [-].
        start_jitter_s: Deviation of when a motor starts about its own lag [s].
    """

    bias_rad: AtLeastZero
    session_rad: AtLeastZero
    sag_rad: AtLeastZero
    friction_rad: AtLeastZero
    friction_spread_rad: AtLeastZero
    scatter_rad: AtLeastZero
    tail_dof: AtLeastZero
    lost: Share
    lost_together: Share
    start_jitter_s: AtLeastZero


ARM_CLASSES: Mapping[str, ArmClass] = {
    "hobby servo": ArmClass(0.0065, 0.001, 0.015, 0.007, 0.005, 0.006, 5.0, 0.03, 0.005, 0.05),
    "industrial": ArmClass(0.003, 0.001, 0.001, 0.0003, 0.0003, 0.0004, 4.0, 0.003, 0.0003, 0.006),
    "cable-driven": ArmClass(0.02, 0.005, 0.02, 0.015, 0.01, 0.01, 4.0, 0.01, 0.001, 0.05),
}
"""Values by class. Hobby servos: rounded from published measurements (settled errors of half a
degree to one degree, a twentieth of commands lost on a shared bus); industrial arms: makers'
absolute accuracy of joints and repeatability; cable-driven: assumed, wide. Starts are assumed: a
bus of servos against a controller with a fixed cycle. The bias of hobby servos, which is also the
scatter between the calibrations of two of them, and their starts were chosen with diagnoses of one
of these known (benchmarks/looks.md)."""
LONG_ARM_M = 0.6
"""Reach from which an arm without a stated class counts as industrial [m]."""


def class_of(robot: Robot) -> ArmClass:
    """Return the values of an arm's class; see `class_name`."""
    return ARM_CLASSES[class_name(robot)]


def class_name(robot: Robot) -> str:
    """Return the class of an arm: stated in its profile, else by its reach."""
    name = robot.profile.arm_class
    if not name:
        return "industrial" if robot.reach > LONG_ARM_M else "hobby servo"
    if name not in ARM_CLASSES:
        raise unknown_name("arm_class", name, list(ARM_CLASSES))
    return name


def generic_imperfections(robot: Robot) -> Imperfections:
    """Return the imperfections of a typical arm of this class, for an uncalibrated robot."""
    name, kind, motors = class_name(robot), class_of(robot), len(robot.motors)
    load = np.sqrt(np.mean(loads_in_range(robot, 0.0) ** 2, axis=0))
    loaded = load > LEAST_LOAD * max(float(load.max()), LEAST_LOAD)
    compliance = np.where(loaded, kind.sag_rad / np.where(loaded, load, 1.0), 0.0)

    def alike(value: float) -> tuple[float, ...]:
        return (value,) * motors

    settling = Settling(
        bias=alike(0.0),
        compliance=tuple(compliance.tolist()),
        friction=alike(kind.friction_rad),
        scatter=alike(kind.scatter_rad),
        tail_dof=kind.tail_dof,
        source=f"what arms of the class {name!r} are like, no calibration",
    )
    variation = Variation(
        bias=alike(kind.bias_rad),
        compliance=alike(1.0),
        friction=alike(kind.friction_spread_rad),
    )
    return Imperfections(
        GENERIC_NAME,
        f"class of arm: {name}",
        settling=settling,
        lost_commands=_losses(robot, kind),
        variation=variation,
        of_class=True,
    )


LEAST_LOAD = 0.01
"""Share of the largest load from which a motor counts as loaded [-]."""


def _losses(robot: Robot, kind: ArmClass) -> tuple[LostCommand, ...]:
    """Return the losses of single motors and of all pairs."""
    single = [LostCommand((name,), kind.lost, kind.lost) for name in robot.motor_names]
    pairs = [
        LostCommand(pair, kind.lost_together, kind.lost_together)
        for pair in combinations(robot.motor_names, 2)
    ]
    return (*single, *pairs)
