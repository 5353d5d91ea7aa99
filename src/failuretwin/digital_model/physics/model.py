"""The arm with its motors: rotors, gears that stick and flex, servos, and brakes for held gears.

Every joint of the URDF becomes two about the same axis: the drive (rotor and gear) and the flex of
the gear's output side. Three actuators act on the drive, and each has a control, so that all that
changes during a run is data:

- set-point: a torque, the part of the servo's law that does not depend on the drive's angle;
- feedback: -(stiffness * q + derivative * q') times its control, the share of its strength that
  the servo has left. (MuJoCo's own PID has fixed gains, so it cannot weaken during a run.)
- brake: viscous, far stiffer than the servo, times its control: 1 holds the gear wherever it is.

Set-point and feedback pull a tendon whose total force is limited, as the motor's torque is; the
brake is part of the gear and not limited. Friction of the gear is a spring that yields.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from failuretwin.core.errors import InputError
from failuretwin.core.types import IntArray
from failuretwin.digital_model.physics.arm import arm_spec
from failuretwin.digital_model.physics.extra import load_mujoco
from failuretwin.digital_model.physics.parameters import MotorPhysics, PhysicsParameters
from failuretwin.digital_model.robot import Robot

BRAKE_S = 2e4
"""Brake torque [N m] at 1 rad/s per N m/rad of servo stiffness [s]. A load under which the servo
would sag by 3 deg makes a held gear creep by 3e-5 rad in 10 s, and stopping a gear takes no
acceleration that MuJoCo would mistake for a simulation gone wrong."""
LEAST_SHARE = 0.2
"""Share of an inertia that is entered at least, however long the step."""


@dataclass(frozen=True)
class PhysicsModel:
    """A compiled model and where to find the motors in it.

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
    robot: Robot, parameters: PhysicsParameters, step: float, payload: float = 0.0
) -> PhysicsModel:
    """Return the model of a robot.

    Args:
        robot: The robot.
        parameters: Its motors.
        step: Time step [s].
        payload: Mass carried at the tool point [kg].

    Raises:
        InputError: If mujoco is missing or cannot use the URDF.
    """
    mujoco = load_mujoco()
    spec = arm_spec(robot, payload)
    spec.option.timestep = step
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.compiler.degree = False
    joints = [motor.joint for motor in robot.motors]
    for joint, motor in zip(joints, parameters.motors, strict=True):
        _add_gear(spec, joint, motor, step)
        _add_tendon(spec, joint, motor.torque_limit)
    for add in (_add_setpoint, _add_feedback, _add_brake):
        for joint, motor in zip(joints, parameters.motors, strict=True):
            add(mujoco, spec, joint, motor)
    try:
        compiled = spec.compile()
    except ValueError as error:
        raise InputError(f"{robot.urdf_file}: MuJoCo cannot use it ({error}).") from error
    return _with_addresses(compiled, joints)


def _with_addresses(compiled: Any, joints: list[str]) -> PhysicsModel:
    drive = [compiled.joint(name).id for name in joints]
    flex = [compiled.joint(_flex(name)).id for name in joints]
    return PhysicsModel(
        compiled,
        compiled.jnt_qposadr[drive].astype(int),
        compiled.jnt_qposadr[flex].astype(int),
        compiled.jnt_plasticadr[drive].astype(int),
    )


def _flex(joint: str) -> str:
    return f"{joint} flex"


def _motor(joint: str) -> str:
    return f"{joint} motor"


def _inertia(inertia: float, damping: float, step: float) -> float:
    """Return the inertia to enter for a joint whose damping is integrated implicitly.

    The integrator's step for x'' = -k x - d x' is, to second order, the exact solution for an
    inertia that is larger by d * step / 2. Entered that much smaller, the error falls with the
    square of the step. At steps too long for that it falls with the step itself.
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
        name=_flex(joint),
        type=drive.type,
        axis=drive.axis,
        pos=drive.pos,
        stiffness=[motor.flex_stiffness, 0.0, 0.0],
        damping=[motor.flex_damping, 0.0, 0.0],
        armature=_inertia(motor.flex_inertia, motor.flex_damping, step),
    )


def _add_tendon(spec: Any, joint: str, limit: float) -> None:
    tendon = spec.add_tendon(name=_motor(joint))
    tendon.wrap_joint(joint, 1.0)
    if limit < float("inf"):
        tendon.actfrclimited = True
        tendon.actfrcrange = [-limit, limit]


def _add_setpoint(mujoco: Any, spec: Any, joint: str, motor: MotorPhysics) -> None:
    actuator = spec.add_actuator(name=f"{joint} set-point", target=_motor(joint))
    actuator.trntype = mujoco.mjtTrn.mjTRN_TENDON


def _add_feedback(mujoco: Any, spec: Any, joint: str, motor: MotorPhysics) -> None:
    actuator = spec.add_actuator(name=f"{joint} feedback", target=_motor(joint))
    actuator.trntype = mujoco.mjtTrn.mjTRN_TENDON
    actuator.gaintype = mujoco.mjtGain.mjGAIN_AFFINE
    actuator.gainprm[:3] = [0.0, -motor.stiffness, -motor.derivative]


def _add_brake(mujoco: Any, spec: Any, joint: str, motor: MotorPhysics) -> None:
    actuator = spec.add_actuator(name=f"{joint} brake", target=joint)
    actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
    actuator.gaintype = mujoco.mjtGain.mjGAIN_AFFINE
    actuator.gainprm[:3] = [0.0, 0.0, -BRAKE_S * motor.stiffness]
