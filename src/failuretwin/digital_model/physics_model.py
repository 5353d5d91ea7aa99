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
from typing import Annotated, Any
from xml.etree import ElementTree

import numpy as np

from failuretwin.core.config import AtLeastZero, Bounded, Bounds, from_table, read_toml
from failuretwin.core.errors import InputError, needs_extra
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.digital_model.geometry import roll_pitch_yaw
from failuretwin.digital_model.kinematics import GRAVITY
from failuretwin.digital_model.profile import Motor
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import poses_in_range
from failuretwin.digital_model.urdf.file import Urdf, read_root, read_urdf

# What the physics engine needs to know of motors and gears, and where it is written down.

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
        armature: Inertia of the rotor behind the gear [kg m2]. friction: Coulomb friction of the
        gear [N m]; the drive stops up to friction / stiffness from its
            set-point.
        friction_yield: Elastic travel before the gear slips [rad].
        torque_limit: Stall torque [N m].
        flex_stiffness: Stiffness of the gear's output side [N m/rad].
        flex_damping: Damping of the output side [N m s/rad].
        flex_inertia: Inertia that only takes part in the flexing, such as the gear's last stage
            [kg m2]; it limits the ringing frequency of a light link.
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
    """Return the parameters in the file that the robot's profile names; None without one.

    Raises:
        InputError: If the file cannot be used or does not fit the robot.
    """
    if robot.profile.physics is None:
        return None
    path = robot.folder / robot.profile.physics
    parameters = from_table(PhysicsParameters, read_toml(path), str(path))
    parameters.check_fit(robot)
    return parameters


# MuJoCo, an optional package that is loaded only where it is used.


def load_mujoco() -> Any:
    """Return the module `mujoco`.

    Raises:
        InputError: If it is not installed.
    """
    with needs_extra("the physics engine needs mujoco", "physics"):
        import mujoco
        import mujoco.rollout
    return mujoco


# A URDF as a rigid arm in MuJoCo: only the motors' joints move, nothing collides.

TOOL = "tool point"
"""Name of the site at the tool point."""

JOINT_PARTS = ("parent", "child", "origin", "axis")
"""Copied parts of a joint; limits, friction and mimicry are dropped."""
NEXT_TO_NOTHING = 1e-9
"""Mass [kg] and moment of inertia [kg m2] of links without stated ones."""


def arm_spec(robot: Robot, payload: float = 0.0) -> Any:
    """Return the robot as a `mujoco.MjSpec` that can still be changed.

    Joints turn in the physical sense and keep their URDF names; joints without a motor stay at
    zero. Gravity points down the z axis of the base frame.

    Args:
        robot: The robot.
        payload: Point mass at the tool point [kg].

    Raises:
        InputError: If mujoco is missing or cannot use the URDF.
    """
    mujoco = load_mujoco()
    path = robot.urdf_file
    root = read_root(path)
    _strip(root, {motor.joint for motor in robot.motors})
    _correct(root, robot)
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise InputError(f"{path}: MuJoCo cannot use it ({error}).") from error
    spec.compiler.fusestatic = True
    spec.compiler.balanceinertia = True
    spec.compiler.boundmass = spec.compiler.boundinertia = NEXT_TO_NOTHING
    spec.option.gravity = -GRAVITY * _up(read_urdf(path), robot.profile.base_link)
    spec.option.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    tool, at = spec.body(robot.profile.tool_link), robot.profile.tool_xyz
    tool.add_site(name=TOOL, pos=at)
    if payload > 0.0:
        point = tool.add_body(name="payload", pos=at, mass=payload, explicitinertial=True)
        point.inertia = np.full(3, NEXT_TO_NOTHING)
    return spec


def _strip(root: ElementTree.Element, moving: set[str]) -> None:
    """Reduce the tree to links with masses and joints, of which only `moving` move."""
    for element in list(root):
        keep = {"link": ("inertial",), "joint": JOINT_PARTS}.get(element.tag)
        if keep is None:
            root.remove(element)
            continue
        if element.tag == "joint" and element.get("name") not in moving:
            element.set("type", "fixed")
        for part in list(element):
            useless = part.tag == "axis" and element.get("type") == "fixed"
            if part.tag not in keep or useless:
                element.remove(part)


def _correct(root: ElementTree.Element, robot: Robot) -> None:
    """Apply the joint corrections of the profile."""
    corrected = {c.joint for c in robot.profile.geometry.joints}
    urdf = robot.profile.geometry.apply(read_urdf(robot.urdf_file))
    poses = {joint.name: joint.T_pc for joint in urdf.joints if joint.name in corrected}
    for element in root.findall("joint"):
        T = poses.get(element.get("name", ""))
        if T is None:
            continue
        for old in element.findall("origin"):
            element.remove(old)
        xyz, rpy = T[:3, 3].tolist(), roll_pitch_yaw(T[:3, :3])
        texts = (" ".join(f"{value:.17g}" for value in triple) for triple in (xyz, rpy))
        element.append(ElementTree.Element("origin", dict(zip(("xyz", "rpy"), texts, strict=True))))


def _up(urdf: Urdf, base_link: str) -> FloatArray:
    """Return the z axis of the base frame in the frame of the URDF's root, (3,)."""
    by_child = {joint.child: joint for joint in urdf.joints}
    up, link = np.array([0.0, 0.0, 1.0]), base_link
    while link in by_child:
        up = by_child[link].T_pc[:3, :3] @ up
        link = by_child[link].parent
    return up


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

    Args:
        robot: The robot.
        motors: Its motors and gears.
        step: Time step [s].
        payload: Mass at the tool point [kg].

    Raises:
        InputError: If mujoco is missing or cannot use the URDF.
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


# Motors and gears for a robot of which only URDF and profile are known: assumed, not measured.

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
    """Return parameters derived from the robot's URDF and movement ranges.

    Raises:
        InputError: If mujoco is missing or cannot use the URDF.
    """
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
