"""An arm of unknown geometry: as few numbers as poses can tell, and what is believed of them.

    p_seen = s P T_1 D_1 Rz(q_1) T_2 D_2 Rz(q_2) ... T_tool p_tool
    q_j = sense_j u_j + zero_j + c_j g_j
    D_j = shift and tilt across axis j: four numbers move a line in space

P is the base in the sensor's frame, s the sensor's scale, T_j the URDF's transforms with axes along
z, u_j the commands and g_j the torque of gravity under which motor j gives way by c_j.

Tool positions tell 4 n + 3 numbers of n joints that turn. What is one number in two ways is left
out: the first axis and its zero are part of P, the last zero is part of p_tool, and a line does not
move as the zero of the joint before it would have it, nor slide along the first axis.

Section: docs/inference.md#calibration-and-geometry
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from failuretwin.connection.student_fit import StudentFit, fit_student
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.digital_model.geometry import (
    NO_OFFSET,
    Geometry,
    JointCorrection,
    Pose,
    roll_pitch_yaw,
    seen_chain,
    with_tool,
)
from failuretwin.digital_model.kinematics import Loads, SerialChain, cross, rotation_to_z
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import poses_in_range
from failuretwin.digital_model.urdf.file import Triple, Urdf, read_urdf, transform
from failuretwin.inference.set_ups.registration import Frame

# Standard deviations of what is believed before any pose is seen.

BASE_M, BASE_RAD = 1.0, 1.0
"""Of the base about where poses put it at first: next to nothing is believed."""
TOOL_M = 0.1
"""Of the tool point about that of the profile: a marker, a pen or a tip on the same hand."""
ZERO_RAD, ZERO_M = 0.2, 0.02
"""Of a zero about the one found at first."""
SHIFT_M, TILT_RAD = 0.002, 0.01
"""Of each axis about its place in the URDF: parts as they are milled or printed, and assembled."""
AXIS_SPREADS = (SHIFT_M, SHIFT_M, TILT_RAD, TILT_RAD)
SCALE = 0.005
"""Of the scale of a tracker or camera."""
SAG_RAD = 0.03
"""Of how far a motor gives way under its largest load, as calibration believes."""
LEAST_LOAD_NM = 1e-6
"""Torque below which gravity does not load a motor [N m]."""

LEAST_TURN_RAD = 1e-4
"""Turn below which first order is exact."""
ANGLES = ("roll", "pitch", "yaw")
"""What the turn of the base is told in; it is fitted about the sensor's x, y and z."""


@dataclass(frozen=True)
class Poses:
    """Where the tool rested.

    Attributes:
        target: Commanded angles, (pose, motor) [rad], log's sense.
        point: Settled tool positions, (pose, 3) [m], in the sensor's frame.
    """

    target: FloatArray
    point: FloatArray

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.target)

    def __getitem__(self, kept: IntArray | slice) -> Poses:
        """Return some of the poses."""
        return Poses(self.target[kept], self.point[kept])

    def spread(self, count: int) -> Poses:
        """Return as many of the poses at most, evenly over all."""
        if len(self) <= count:
            return self
        return self[np.rint(np.linspace(0, len(self) - 1, count)).astype(int)]


@dataclass(frozen=True)
class Unknown:
    """One number of the fit.

    Attributes:
        name: What it is.
        motor: Index of the motor that it belongs to; None: the whole arm.
        unit: Its unit.
        spread: Standard deviation before any pose is seen.
    """

    name: str
    motor: int | None
    unit: str
    spread: float


class Unknowns(tuple[Unknown, ...]):
    """The numbers of a fit, in order."""

    @cached_property
    def place(self) -> dict[tuple[str, int | None], int]:
        """Where each stands, by name and motor."""
        return {(unknown.name, unknown.motor): i for i, unknown in enumerate(self)}

    @cached_property
    def spread(self) -> FloatArray:
        """Standard deviation of each before any pose is seen, (unknown,)."""
        return np.array([unknown.spread for unknown in self])

    def of_axis(self, j: int) -> list[int]:
        """Return where the numbers of an axis stand."""
        return [i for (name, j_), i in self.place.items() if j_ == j and name.startswith("axis ")]


@dataclass(frozen=True)
class Start:
    """Senses, zeros and frame that a fit starts from, and that its numbers are relative to.

    Attributes:
        sense: Of each motor, (motor,).
        zero: Of each joint, (motor,) [rad or m].
        frame: The base in the sensor's frame.
    """

    sense: FloatArray
    zero: FloatArray
    frame: Frame


@dataclass(frozen=True)
class Arm:
    """An arm by its URDF, with the tool point of its profile, which says nothing else of geometry.

    Attributes:
        robot: The robot.
    """

    robot: Robot

    @property
    def motors(self) -> int:
        """Number of motors."""
        return len(self.robot.motors)

    @cached_property
    def urdf(self) -> Urdf:
        """The URDF."""
        return read_urdf(self.robot.urdf_file)

    @cached_property
    def chain(self) -> SerialChain:
        """Chain in the frame of the base link, to the tool link."""
        profile, names = self.robot.profile, [motor.joint for motor in self.robot.motors]
        return self.urdf.chain(profile.base_link, profile.tool_link, names)

    @cached_property
    def slides(self) -> list[bool]:
        """Whether each joint slides."""
        return [joint.prismatic for joint in self.chain.joints]

    @cached_property
    def start_zero(self) -> FloatArray:
        """Zeros that the profile has, (motor,)."""
        known = {c.joint: c.zero for c in self.robot.profile.geometry.joints}
        return np.array([known.get(joint.name, 0.0) for joint in self.chain.joints])

    @cached_property
    def lines(self) -> list[FloatArray]:
        """Ways in which each axis may move across itself, by joint, (4, way) in units of belief."""
        return [self._line(j) for j in range(self.motors)]

    def _line(self, j: int) -> FloatArray:
        if j == 0:
            return np.zeros((4, 0))
        T = self.chain.joints[j].T_pj
        along = T[2, :3]  # the axis before, in the frame of this joint
        across = np.cross([0.0, 0.0, 1.0], T[:3, 3]) @ T[:3, :3]
        turns = np.array([*across[:2], *along[:2]])
        slides = np.array([*along[:2], 0.0, 0.0])
        known = [slides if self.slides[j - 1] else turns]
        if j == 1:
            known.append(turns if self.slides[0] else slides)
        unit = np.array(AXIS_SPREADS)
        whitened = np.array(known) / unit
        size = np.linalg.norm(whitened, axis=1, keepdims=True)
        kept = whitened[size[:, 0] > 1e-9] / size[size > 1e-9][:, None]
        return np.eye(4) if len(kept) == 0 else np.asarray(null_space(kept))

    @cached_property
    def loads(self) -> FloatArray:
        """Largest torque of gravity on each motor within its range, (motor,) [N m]."""
        return np.abs(self.gravity.torque(poses_in_range(self.robot))).max(axis=0)

    @cached_property
    def gravity(self) -> Loads:
        """What the motors carry, as the URDF has it."""
        return self.urdf.loads(self.robot.profile.base_link, self.chain)

    def torque(self, target: FloatArray, start: Start) -> FloatArray:
        """Return the torque of gravity in poses, (pose, motor) [N m], driving the seen joint up.

        Where the sensor's pose is that of the log, gravity still acts on the physical one.
        """
        own = np.array_equal(start.sense, self.robot.sensor_sense)
        sense = self.robot.sense if own else start.sense
        return sense * start.sense * self.gravity.torque(sense * target + start.zero)

    def frames(self) -> Unknowns:
        """Return what registration alone asks: base, tool point, zeros."""
        base = [Unknown(f"base {axis}", None, "m", BASE_M) for axis in "xyz"]
        turn = [Unknown(f"base {angle}", None, "rad", BASE_RAD) for angle in ANGLES]
        tool = [Unknown(f"tool {axis}", None, "m", TOOL_M) for axis in "xyz"]
        zeros = [
            Unknown("zero", j, *(("m", ZERO_M) if self.slides[j] else ("rad", ZERO_RAD)))
            for j in range(1, self.motors - 1)
        ]
        return Unknowns([*base, *turn, *tool, *zeros])

    def details(self) -> Unknowns:
        """Return all that is asked: registration, scale, sag and where the axes are."""
        scale = [] if any(self.slides) else [Unknown("sensor scale", None, "-", SCALE)]
        sag = [
            Unknown("sag", j, "rad/(N m)", SAG_RAD / load)
            for j, load in enumerate(self.loads)
            if load > LEAST_LOAD_NM
        ]
        lines = [
            Unknown(f"axis {way + 1}", j, "-", 1.0)
            for j, ways in enumerate(self.lines)
            for way in range(ways.shape[1])
        ]
        return Unknowns([*self.frames(), *scale, *sag, *lines])


@dataclass(frozen=True)
class Fitted:
    """An arm with numbers for what was unknown.

    Attributes:
        arm: The arm.
        start: What they are relative to.
        unknowns: What they are.
        values: They, (unknown,).
    """

    arm: Arm
    start: Start
    unknowns: Unknowns
    values: FloatArray

    def value(self, name: str, motor: int | None = None) -> float:
        """Return one of them; 0 for what was not asked."""
        at = self.unknowns.place.get((name, motor))
        return 0.0 if at is None else float(self.values[at])

    def _three(self, *names: str) -> FloatArray:
        return np.array([self.value(name) for name in names])

    @property
    def scale(self) -> float:
        """Length that the sensor tells of a metre."""
        return 1.0 + self.value("sensor scale")

    @property
    def turn(self) -> FloatArray:
        """Turn of the base in the sensor's frame, (3, 3)."""
        turn = Rotation.from_rotvec(self._three(*(f"base {angle}" for angle in ANGLES)))
        return np.asarray(turn.as_matrix() @ self.start.frame.R)

    @property
    def origin(self) -> FloatArray:
        """Origin of the base in the sensor's frame, (3,) [m]."""
        return self.start.frame.origin + self._three("base x", "base y", "base z")

    @property
    def tool_xyz(self) -> Triple:
        """Tool point in the frame of the tool link [m]."""
        return _triple(
            np.asarray(self.arm.robot.profile.tool_xyz) + self._three("tool x", "tool y", "tool z")
        )

    @property
    def base_xyz_rpy(self) -> Pose:
        """Pose of the base link in the sensor's frame."""
        return *_triple(self.origin), *roll_pitch_yaw(self.turn)

    def zero(self, j: int) -> float:
        """Return the zero of a joint."""
        return float(self.start.zero[j]) + self.value("zero", j)

    def moved(self, j: int) -> FloatArray:
        """Return how an axis is moved: shift x, y [m] and tilt x, y [rad] in its frame, (4,)."""
        at = self.unknowns.of_axis(j)
        unit = np.array(AXIS_SPREADS)
        return np.asarray(unit * (self.arm.lines[j] @ self.values[at])) if at else np.zeros(4)

    def _joint_pose(self, j: int) -> FloatArray:
        joint, along = self.arm.chain.joints[j], (0.0, 0.0, self.zero(j))
        own = (along, NO_OFFSET) if joint.prismatic else (NO_OFFSET, along)
        return joint.T_pj @ _across(self.moved(j)) @ transform(*own)

    @cached_property
    def chain(self) -> SerialChain:
        """The chain as the sensor sees it."""
        joints = enumerate(self.arm.chain.joints)
        moved = tuple(replace(joint, T_pj=self._joint_pose(j)) for j, joint in joints)
        whole = with_tool(replace(self.arm.chain, joints=moved), self.tool_xyz)
        return seen_chain(whole, self.base_xyz_rpy, self.scale)

    def expected(self, target: FloatArray, torque: FloatArray) -> FloatArray:
        """Return where the tool should be seen, (pose, 3) [m].

        Args:
            target: Commanded angles, (pose, motor) [rad].
            torque: Gravity on the motors there, (pose, motor) [N m].
        """
        return self.chain.position(self._joints(target, torque))

    def _joints(self, target: FloatArray, torque: FloatArray) -> FloatArray:
        """Return joint values beside their zeros, (pose, motor) [rad or m]."""
        sag = np.array([self.value("sag", j) for j in range(self.arm.motors)])
        return self.start.sense * target + sag * torque

    def slopes(self, target: FloatArray, torque: FloatArray) -> FloatArray:
        """Return the derivative of `expected` by the unknowns, (pose, 3, unknown).

        With p the tool and o, R origin and rotation of a frame, a shift of the frame along its axis
        k moves p by R e_k, a turn by w about its axes by R J e_k x (p - o), J = J(w).
        """
        q = self._joints(target, torque)
        frames, motors = self.chain.frames_by_joint(q), range(self.arm.motors)
        point, from_base = frames[-1, 3], frames[-1, 3] - self.origin[:, None]
        jacobian = np.moveaxis(self.chain.position_and_jacobian(q)[1], 0, -1)  # (3, joint, pose)
        base = np.broadcast_to(np.eye(3)[..., None], (3, *point.shape))
        turns = _left_jacobian(self._three(*(f"base {angle}" for angle in ANGLES))).T[..., None]
        found: dict[tuple[str, int | None], FloatArray] = {
            ("sensor scale", None): from_base / self.scale
        }
        for k, axis in enumerate("xyz"):
            found["base " + axis, None] = base[k]
            found["base " + ANGLES[k], None] = cross(turns[k], from_base, 0)
            found["tool " + axis, None] = self.scale * frames[-1, k]
        for j in motors:
            found["zero", j] = jacobian[:, j]
            found["sag", j] = jacobian[:, j] * torque[:, j]
            moves = self._moves(j, frames[j], point)
            for way, line in enumerate(self.arm.lines[j].T * AXIS_SPREADS):
                found[f"axis {way + 1}", j] = np.tensordot(line, moves, 1)
        return np.stack([found[one.name, one.motor].T for one in self.unknowns], axis=-1)

    def _moves(self, j: int, frame: FloatArray, point: FloatArray) -> FloatArray:
        """Return the derivative of the tool by the shift and tilt of an axis, (4, 3, pose).

        Args:
            j: Index of the joint.
            frame: x, y, z axis and origin of its frame, (4, 3, pose).
            point: Tool positions, (3, pose) [m].
        """
        joint, zero, tilt = self.arm.chain.joints[j], self.zero(j), self.moved(j)[2:]
        own = 0.0 if joint.prismatic else zero
        turned = _across(self.moved(j))[:3, :3] @ transform(NO_OFFSET, (0.0, 0.0, own))[:3, :3]
        axes = np.tensordot(turned, frame[:3], 1)  # before shift, tilt and zero
        arm = point - frame[3] + (zero if joint.prismatic else 0.0) * frame[2]
        about = np.tensordot(_left_jacobian(np.array([*tilt, 0.0])).T[:2], axes, 1)
        return np.concatenate([self.scale * axes[:2], cross(about, arm[None], 1)])

    def geometry(self, noise_m: float, source: str) -> Geometry:
        """Return it as a profile says it; `noise_m` is left unexplained on each axis [m]."""
        joints = tuple(self._correction(j) for j in range(self.arm.motors))
        return Geometry(joints, self.scale, noise_m, source)

    def _correction(self, j: int) -> JointCorrection:
        name, turn = self.arm.chain.joints[j].name, np.eye(4)
        axis = next(joint.axis for joint in self.arm.urdf.joints if joint.name == name)
        turn[:3, :3] = rotation_to_z(axis)
        T = turn @ _across(self.moved(j)) @ turn.T
        return JointCorrection(name, self.zero(j), _triple(T[:3, 3]), roll_pitch_yaw(T[:3, :3]))


@dataclass(frozen=True)
class Posterior(Fitted):
    """The most probable arm by poses.

    Attributes:
        told: The fit, in units of what was believed before and metres.
    """

    told: StudentFit


def fit(
    arm: Arm, start: Start, unknowns: Unknowns, poses: Poses, begin: FloatArray | None = None
) -> Posterior:
    """Return an arm fitted to poses, from `start` and numbers `begin` (unknown,); None: 0."""
    spread, torque = unknowns.spread, arm.torque(poses.target, start)

    def residual(x: FloatArray) -> FloatArray:
        expected = Fitted(arm, start, unknowns, x * spread).expected(poses.target, torque)
        return np.asarray(poses.point - expected)

    def slopes(x: FloatArray) -> FloatArray:
        return -Fitted(arm, start, unknowns, x * spread).slopes(poses.target, torque) * spread

    begin = np.zeros(len(unknowns)) if begin is None else begin
    told = fit_student(residual, begin / spread, 3, slopes)
    return Posterior(arm, start, unknowns, told.value * spread, told)


def _triple(values: FloatArray) -> Triple:
    x, y, z = values.tolist()
    return x, y, z


def _left_jacobian(w: FloatArray) -> FloatArray:
    """Return J (3, 3) of a turn about w [rad]: exp(w + dw) = exp(J dw) exp(w) to first order.

    J = I + (1 - cos a) / a^2 [w]x + (a - sin a) / a^3 [w]x^2,    a = |w|
    """
    angle, x = float(np.linalg.norm(w)), cross(np.eye(3), w)
    if angle < LEAST_TURN_RAD:
        return np.asarray(np.eye(3) + 0.5 * x)
    first, second = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * x + second * x @ x)


def _across(moved: FloatArray) -> FloatArray:
    """Return the transform (4, 4) that moves an axis across itself by shift and tilt, (4,)."""
    T = np.eye(4)
    if moved.any():
        T[:3, :3] = Rotation.from_rotvec([moved[2], moved[3], 0.0]).as_matrix()
        T[:2, 3] = moved[:2]
    return T
