"""Motors and gears for the physics engine: from a file, or assumed from URDF and profile."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from failuretwin.core.config import AtLeastZero, Bounded, Bounds, from_table, read_toml
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.physics.arm import arm_spec, load_mujoco
from failuretwin.digital_model.profile import Motor
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import poses_in_range
from failuretwin.digital_model.urdf.file import read_urdf

AboveZero = Annotated[float, Bounds(1e-12, 1e12)]


@dataclass(frozen=True)
class MotorPhysics(Bounded):
    """A motor with its servo and its gear. For a sliding joint read N for N m and m for rad.

    Servo: torque = stiffness * (s - q) + derivative * (s' - q'), within the torque limit, with q
    the angle of the drive and s the reference after a first-order filter. The largest speed is in
    the profile.

    Attributes:
        name: Name of the motor.
        stiffness: Proportional gain of the servo [N m/rad].
        derivative: Gain of the servo on the error's speed [N m s/rad].
        filter_s: Time constant of the set-point filter [s].
        damping: Back-EMF and viscous friction of the drive [N m s/rad]; the speed is limited to
            torque_limit / damping.
        armature: Inertia of the rotor behind the gear [kg m2].
        friction: Coulomb friction of the gear [N m]; the drive stops up to friction / stiffness
            from its set-point.
        friction_yield: Elastic travel before the gear slips [rad].
        torque_limit: Stall torque [N m].
        flex_stiffness: Stiffness of the gear's output side [N m/rad].
        flex_damping: Damping of the output side [N m s/rad].
        flex_inertia: Inertia that only takes part in the flexing, such as the gear's last stage [kg
            m2]; it limits the ringing frequency of a light link.
    """

    name: str
    stiffness: AboveZero
    derivative: AtLeastZero
    filter_s: AboveZero
    damping: AtLeastZero
    armature: AboveZero
    friction: AtLeastZero
    friction_yield: AboveZero
    torque_limit: Annotated[float, Bounds(1e-12, math.inf)]
    flex_stiffness: AboveZero
    flex_damping: AtLeastZero
    flex_inertia: AboveZero

    @property
    def compliance(self) -> float:
        """Yielding of the output side under load at rest [rad/(N m)]."""
        return 1.0 / self.stiffness + 1.0 / self.flex_stiffness


@dataclass(frozen=True)
class PhysicsParameters:
    """Motors of one robot.

    Attributes:
        source: Source of the values.
        motors: One entry per motor of the robot, in chain order.
    """

    source: str
    motors: tuple[MotorPhysics, ...]

    def check_fit(self, robot: Robot) -> None:
        """Raise InputError unless the motors are those of `robot`, in its order."""
        names = [motor.name for motor in self.motors]
        if names != robot.motor_names:
            raise InputError(
                f"physics parameters are for motors {', '.join(names)}; {robot.name!r} has "
                f"{', '.join(robot.motor_names)}. List exactly these, in this order."
            )


def load_parameters(robot: Robot) -> PhysicsParameters | None:
    """Return the parameters in the file that the robot's profile names; None without one."""
    if robot.profile.physics is None:
        return None
    path = robot.folder / robot.profile.physics
    parameters = from_table(PhysicsParameters, read_toml(path), str(path))
    parameters.check_fit(robot)
    return parameters


# Default parameters: assumed, not measured.

SAG_RAD = math.radians(0.5)
"""Largest displacement of a joint under its largest load."""
FRICTION_RAD = math.radians(0.1)
"""Largest distance from its set-point at which friction stops a drive."""
YIELD_RAD = FRICTION_RAD
FLEX_SHARE = 1.0 / 3.0
"""Share of the sag in the gear's output side, the rest is in the servo."""
FULL_TORQUE_RAD = math.radians(20.0)
"""Largest error at which a servo gives its full torque."""
SERVO_RAD_S = 40.0
"""Smallest natural frequency of a servo with its joint's largest inertia."""
RINGING_RAD_S = 150.0
"""Largest natural frequency of rotors and gears alone; it sets their inertia."""
FILTER_S = 0.03
"""Smallest time constant of the set-point filter [s]; larger where the torque beyond the largest
load needs more time to bring the largest inertia to the speed of a fast ramp."""
FAST_RAMP_S = 0.6
"""Time of a fast ramp from zero or through the movement range: the paper's shortest (arXiv
2411.01360)."""
FLEX_DAMPING_RATIO = 0.3
BACK_EMF_SHARE = 0.2
"""Share of its torque that a motor needs at its largest speed."""
ROTOR_SHARE = 0.2
"""Smallest ratio of a rotor's inertia behind its gear to the joint's largest inertia."""
SPARE_TORQUE = 2.0
"""Smallest ratio of a motor's torque to its largest load; a URDF with less has a placeholder."""


def default_parameters(robot: Robot) -> PhysicsParameters:
    """Return parameters derived from the robot's URDF and movement ranges."""
    load, inertia, effort = _arm_facts(robot)
    figures = np.stack([load, inertia, effort], axis=1).tolist()
    motors = tuple(_assumed(m, *facts) for m, facts in zip(robot.motors, figures, strict=True))
    return PhysicsParameters("assumed: derived from masses and limits of the URDF", motors)


def _assumed(motor: Motor, load: float, inertia: float, effort: float) -> MotorPhysics:
    stiffness = max(
        load / SAG_RAD / (1.0 - FLEX_SHARE),
        (1.0 + ROTOR_SHARE) * inertia * SERVO_RAD_S**2,
        effort / FULL_TORQUE_RAD if math.isfinite(effort) else 0.0,
    )
    flex_stiffness = stiffness * (1.0 - FLEX_SHARE) / FLEX_SHARE
    friction = stiffness * FRICTION_RAD
    springs = stiffness + flex_stiffness + friction / YIELD_RAD
    armature = max(ROTOR_SHARE * inertia, springs / RINGING_RAD_S**2)
    travel = max(motor.movement_range[1], 0.0) - min(motor.movement_range[0], 0.0)
    fast = min(motor.speed_limit, travel / FAST_RAMP_S)
    flex_inertia = flex_stiffness / RINGING_RAD_S**2
    return MotorPhysics(
        name=motor.name,
        stiffness=stiffness,
        derivative=2.0 * math.sqrt(stiffness * (inertia + armature)),
        filter_s=max(FILTER_S, (inertia + armature) * fast / (effort - load)),
        damping=BACK_EMF_SHARE * effort / motor.speed_limit if math.isfinite(effort) else 0.0,
        armature=armature,
        friction=friction,
        friction_yield=YIELD_RAD,
        torque_limit=effort,
        flex_stiffness=flex_stiffness,
        flex_damping=2.0 * FLEX_DAMPING_RATIO * math.sqrt(flex_stiffness * flex_inertia),
        flex_inertia=flex_inertia,
    )


def _arm_facts(robot: Robot) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return largest load [N m], inertia [kg m2] and effort [N m] of each motor, (motor,) each."""
    mujoco = load_mujoco()
    model = arm_spec(robot).compile()
    data = mujoco.MjData(model)
    load, inertia = np.zeros((2, len(robot.motors)))
    mass = np.zeros((model.nv, model.nv))
    for pose in poses_in_range(robot):
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        load = np.maximum(load, np.abs(data.qfrc_bias))
        inertia = np.maximum(inertia, np.diag(mass))
    limits = {joint.name: joint.effort or math.inf for joint in read_urdf(robot.urdf_file).joints}
    effort = np.array([limits[motor.joint] for motor in robot.motors])
    return load, inertia, np.maximum(effort, SPARE_TORQUE * load)
