"""MuJoCo model of the arm with its motors: rotors, sticking and flexing gears, servos, gear brakes.

Every joint of the URDF becomes two about the same axis: the drive (rotor and gear) and the flex of
the gear's output side. Three actuators act on the drive, each with a control, so that all changes
during a run are data:

- set-point: a torque, the part of the servo's law that does not depend on the drive's angle;
- feedback: -(stiffness * q + derivative * q') times its control, the share of its strength that
  the servo has left. (MuJoCo's own PID has fixed gains, so it cannot weaken during a run.)
- brake: viscous, far stiffer than the servo, times its control: 1 holds the gear at its angle.

Set-point and feedback pull a tendon whose total force is limited, as the motor's torque is; the
brake is part of the gear and not limited. Friction of the gear is a spring that yields.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from failuretwin.core.errors import InputError
from failuretwin.core.types import IntArray
from failuretwin.digital_model.physics.arm import arm_spec, load_mujoco
from failuretwin.digital_model.physics.motors import MotorPhysics
from failuretwin.digital_model.robot import Robot

BRAKE_S = 2e4
"""Brake torque [N m] at 1 rad/s per N m/rad of servo stiffness [s]. A load under which the servo
sags by 3 deg makes a held gear creep by 3e-5 rad in 10 s; stopping a gear stays below the
acceleration that MuJoCo treats as an unstable simulation."""
LEAST_SHARE = 0.2
"""Smallest share of an inertia that is entered, however long the step."""


@dataclass(frozen=True)
class PhysicsModel:
    """A compiled model and the indices of its motors.

    Attributes:
        compiled: The `mujoco.MjModel`.
        drive: Index of each motor's drive in qpos and qvel, (motor,).
        flex: Index of each motor's flex in qpos and qvel, (motor,).
        friction: Index of the rest angle of each motor's friction spring in the plastic state,
            (motor,); -1 for a gear without friction.
    """

    compiled: Any
    drive: IntArray
    flex: IntArray
    friction: IntArray


def build_model(
    robot: Robot, motors: Sequence[MotorPhysics], step: float, payload: float = 0.0
) -> PhysicsModel:
    """Return the model of a robot.

    The time step is in s; the payload is a mass at the tool point [kg].
    """
    mujoco = load_mujoco()
    spec = arm_spec(robot, payload)
    spec.option.timestep = step
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.compiler.degree = False
    gears = dict(zip((motor.joint for motor in robot.motors), motors, strict=True))
    for joint, motor in gears.items():
        _add_gear(spec, joint, motor, step)
    _add_actuators(spec, gears)
    try:
        compiled = spec.compile()
    except ValueError as error:
        raise InputError(f"{robot.urdf_file}: MuJoCo cannot use it ({error}).") from error
    drive = [compiled.joint(joint).id for joint in gears]
    flex = [compiled.joint(f"{joint} flex").id for joint in gears]
    positions, plastic = compiled.jnt_qposadr.astype(int), compiled.jnt_plasticadr.astype(int)
    return PhysicsModel(compiled, positions[drive], positions[flex], plastic[drive])


def _inertia(inertia: float, damping: float, step: float) -> float:
    """Return the inertia to enter for a joint whose damping is integrated implicitly.

    The integrator's step for x'' = -k x - d x' is, to second order, the exact solution for an
    inertia larger by d * step / 2. With that subtracted, the error falls with the square of the
    step; at very long steps, with the step itself.
    """
    return max(inertia - 0.5 * damping * step, LEAST_SHARE * inertia)


def _add_gear(spec: Any, joint: str, motor: MotorPhysics, step: float) -> None:
    drive = spec.joint(joint)
    drive.damping = [motor.damping, 0.0, 0.0]
    drive.armature = _inertia(motor.armature, motor.damping + motor.derivative, step)
    if motor.friction > 0.0:
        drive.stiffness = [motor.friction / motor.friction_yield, 0.0, 0.0]
        drive.springyield = motor.friction_yield
    drive.parent.add_joint(
        name=f"{joint} flex",
        type=drive.type,
        axis=drive.axis,
        pos=drive.pos,
        stiffness=[motor.flex_stiffness, 0.0, 0.0],
        damping=[motor.flex_damping, 0.0, 0.0],
        armature=_inertia(motor.flex_inertia, motor.flex_damping, step),
    )
    tendon = spec.add_tendon(name=f"{joint} motor")
    tendon.wrap_joint(joint, 1.0)
    if motor.torque_limit < math.inf:
        tendon.actfrclimited = True
        tendon.actfrcrange = [-motor.torque_limit, motor.torque_limit]


def _add_actuators(spec: Any, gears: Mapping[str, MotorPhysics]) -> None:
    """Add all set-points, then all feedbacks, then all brakes: the order of the controls."""
    mujoco = load_mujoco()
    tendon, own = mujoco.mjtTrn.mjTRN_TENDON, mujoco.mjtTrn.mjTRN_JOINT
    for kind in ("set-point", "feedback", "brake"):
        for joint, motor in gears.items():
            target, type_ = (joint, own) if kind == "brake" else (f"{joint} motor", tendon)
            actuator = spec.add_actuator(name=f"{joint} {kind}", target=target)
            actuator.trntype = type_
            if kind != "set-point":
                actuator.gaintype = mujoco.mjtGain.mjGAIN_AFFINE
                feedback = [0.0, -motor.stiffness, -motor.derivative]
                brake = [0.0, 0.0, -BRAKE_S * motor.stiffness]
                actuator.gainprm[:3] = feedback if kind == "feedback" else brake
