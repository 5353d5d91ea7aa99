"""Motors and gears for a robot of which only URDF and profile are known: assumed, not measured.

Sizes follow from the loads and inertias of the arm over the profile's movement ranges, so that any
arm behaves like one with ordinary position servos.
"""

from __future__ import annotations

import math

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.digital_model.physics.arm import arm_spec
from failuretwin.digital_model.physics.extra import load_mujoco
from failuretwin.digital_model.physics.parameters import MotorPhysics, PhysicsParameters
from failuretwin.digital_model.robot import Motor, Robot
from failuretwin.digital_model.urdf import read_urdf

SAG_RAD = math.radians(0.5)
"""How far a joint gives way under its largest load, at most."""
FRICTION_RAD = math.radians(0.1)
"""How far from its set-point friction lets a drive come to rest, at most."""
YIELD_RAD = FRICTION_RAD
FLEX_SHARE = 1.0 / 3.0
"""Share of the sag that comes from the gear's output side, the rest from the servo."""
FULL_TORQUE_RAD = math.radians(20.0)
"""Error at which a servo gives all its torque, at most."""
SERVO_RAD_S = 40.0
"""Natural frequency of a servo that moves its joint's largest inertia, at least."""
RINGING_RAD_S = 150.0
"""Rotors and gears are given enough inertia to ring no faster than this by themselves."""
FILTER_S = 0.03
"""Time constant of the set-point filter, at least [s]; slower where the torque that is left under
the largest load would not bring the largest inertia to the speed of a fast ramp within it."""
FAST_RAMP_S = 0.6
"""Time of a fast ramp from zero or through the movement range: the shortest that the paper draws
(arXiv 2411.01360)."""
FLEX_DAMPING_RATIO = 0.3
BACK_EMF_SHARE = 0.2
"""Share of its torque that a motor needs to turn at its largest speed."""
ROTOR_SHARE = 0.2
"""Inertia of a rotor behind its gear over the largest inertia of the joint, at least."""
SPARE_TORQUE = 2.0
"""Torque of a motor over its largest load, at least; a URDF that states less has a placeholder."""
POSES = 500


def default_parameters(robot: Robot) -> PhysicsParameters:
    """Return parameters derived from the robot's URDF and movement ranges.

    Raises:
        InputError: If mujoco is missing or cannot use the URDF.
    """
    load, inertia, effort = _arm_facts(robot)
    figures = np.stack([load, inertia, effort], axis=1).tolist()
    motors = tuple(
        _motor(motor, *of_motor) for motor, of_motor in zip(robot.motors, figures, strict=True)
    )
    return PhysicsParameters("assumed: derived from masses and limits of the URDF", motors)


def _motor(motor: Motor, load: float, inertia: float, effort: float) -> MotorPhysics:
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
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    poses = np.random.default_rng(0).uniform(low, high, (POSES, len(low))) * robot.sense
    load, inertia = np.zeros((2, len(low)))
    mass = np.zeros((model.nv, model.nv))
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        load = np.maximum(load, np.abs(data.qfrc_bias))
        inertia = np.maximum(inertia, np.diag(mass))
    limits = {joint.name: joint.effort or math.inf for joint in read_urdf(robot.urdf_file).joints}
    effort = np.array([limits[motor.joint] for motor in robot.motors])
    return load, inertia, np.maximum(effort, SPARE_TORQUE * load)
