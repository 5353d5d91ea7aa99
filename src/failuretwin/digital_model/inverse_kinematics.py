"""Inverse kinematics: damped least squares with limits and locked joints.

    dq = J^T (J J^T + lambda I)^-1 r,    r = goal - tool(q)

Locked joints, and joints that dq would move beyond a limit, have no column in J. A step that does
not reduce the error is rejected and raises lambda (Levenberg-Marquardt). Each goal is tried from
many start poses at once, since a single start misses poses at limits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.kinematics import SerialChain, cross
from failuretwin.digital_model.robot import Robot

POINTER_M = 0.1
"""Distance of the two tool points that express a direction [m]: 1 mm between them is 0.6 deg."""
CLOSE_M = 1e-5
"""Accepted distance of the tool from its goal [m]."""
MOST_STEPS = 60
SLOWEST = 0.9
"""Share to which the error must fall in `PATIENCE` steps; otherwise the search stops."""
PATIENCE = 5
ENOUGH = 0.3
"""Share of successful starts at which the search for a goal ends."""
LONGEST_STEP = 0.5
"""Largest change of a joint per step [rad or m]."""
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-9, 10.0
"""Initial lambda and its bounds [m2]."""
EASED, RAISED = 0.2, 5.0
"""Factors on lambda after an accepted and a rejected step."""
AT_LIMIT = 1e-9
STARTS = 10
"""Default number of start poses."""
UNLIMITED = np.pi
"""Range on either side of zero for a joint without limits [rad or m]."""


@dataclass(frozen=True)
class Poses:
    """Result for each goal and start.

    Attributes:
        pose: Angles in the log's sense, (goal, start, motor) [rad].
        miss_m: Distance of the tool from the goal, (goal, start) [m].
        miss_rad: Angle between tool axis and requested direction, (goal, start) [rad]; 0 without
            one.
    """

    pose: FloatArray
    miss_m: FloatArray
    miss_rad: FloatArray


@dataclass(frozen=True)
class InverseKinematics:
    """Inverse kinematics of a robot, in the log's sense and the frame of its tool sensor.

    Attributes:
        robot: The robot.
        low: Lowest angle of each motor, (motor,) [rad].
        high: Highest angle, (motor,) [rad].
    """

    robot: Robot
    low: FloatArray
    high: FloatArray

    def __post_init__(self) -> None:
        motors = len(self.robot.motors)
        if np.shape(self.low) != (motors,) or np.shape(self.high) != (motors,):
            raise InputError(f"limits have no value for each of the {motors} motors.")
        if not np.all(self.low <= self.high):
            raise InputError("a lowest angle lies above the highest. Expected them in order.")

    @classmethod
    def of(cls, robot: Robot) -> InverseKinematics:
        """Return that of a robot with the limits of its joints."""
        low, high = usable_limits(robot)
        return cls(robot, low, high)

    def starts(
        self, count: int, rng: np.random.Generator, first: FloatArray | None = None
    ) -> FloatArray:
        """Return `count` random poses, (start, motor) [rad]; the first is `first` where given."""
        drawn = rng.uniform(self.low, self.high, (count, len(self.low)))
        if first is not None:
            drawn[0] = np.clip(first, self.low, self.high)
        return drawn

    def tool(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return tool points (..., 3) [m] and Jacobians (..., 3, motor) [m/rad] of poses."""
        return self._tool(0.0, pose)

    def axis(self, pose: FloatArray) -> FloatArray:
        """Return the z axis of the tool frame, unit vectors (..., 3), of poses."""
        points, _ = self._tool(POINTER_M, pose)
        return np.asarray((points[..., 3:] - points[..., :3]) / POINTER_M)

    def _tool(self, pointer_m: float, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        sense = self.robot.sensor_sense
        point, jacobian = tool_points(self.robot.chain, pose * sense, pointer_m)
        return point, jacobian * sense

    def solve(
        self,
        position: FloatArray,
        start: FloatArray,
        locked: BoolArray | None = None,
        direction: FloatArray | None = None,
    ) -> Poses:
        """Return the poses that bring the tool nearest to some goals.

        Args:
            position: Goals of the tool, (goal, 3) [m].
            start: Start poses, (goal, start, motor) or (start, motor) [rad].
            locked: Motors that keep their angle in `start`, even beyond their limits, (motor,).
            direction: Goals of the tool frame's z axis, unit vectors (goal, 3); None: any.
        """
        pointer_m = 0.0 if direction is None else POINTER_M
        goal = position
        if direction is not None:
            goal = np.concatenate([position, position + POINTER_M * direction], axis=-1)
        shape = (len(goal), *start.shape[-2:])
        begin = np.broadcast_to(start, shape).reshape(-1, shape[-1])
        wanted = np.repeat(goal, shape[1], axis=0)
        free = np.ones(shape[-1], dtype=bool) if locked is None else ~locked
        pose = self._search(pointer_m, wanted, begin, free, shape[1])
        point, _ = self._tool(pointer_m, pose)
        miss_m = np.linalg.norm(wanted[:, :3] - point[:, :3], axis=-1)
        miss_rad = np.zeros(len(pose))
        if direction is not None:
            axis, requested = point[:, 3:] - point[:, :3], wanted[:, 3:] - wanted[:, :3]
            miss_rad = angle_between(axis / POINTER_M, requested / POINTER_M)
        by_goal = shape[:2]
        return Poses(pose.reshape(shape), miss_m.reshape(by_goal), miss_rad.reshape(by_goal))

    def _search(
        self,
        pointer_m: float,
        goal: FloatArray,
        begin: FloatArray,
        free: BoolArray,
        starts: int,
    ) -> FloatArray:
        """Return the nearest poses (case, motor) for goals (case, 3 or 6)."""
        pose = np.where(free, np.clip(begin, self.low, self.high), begin)
        damping = np.full(len(pose), DAMPING)
        point, jacobian = self._tool(pointer_m, pose)
        residual = goal - point
        square = np.sum(residual**2, axis=-1)
        checked = square.copy()
        for step in range(1, MOST_STEPS + 1):
            tried = pose + self._step(jacobian, residual, damping, pose, free)
            tried = np.where(free, np.clip(tried, self.low, self.high), pose)
            point, slope = self._tool(pointer_m, tried)
            left = goal - point
            error = np.sum(left**2, axis=-1)
            better = error < square
            pose = np.where(better[:, None], tried, pose)
            residual = np.where(better[:, None], left, residual)
            jacobian = np.where(better[:, None, None], slope, jacobian)
            square = np.where(better, error, square)
            damping = np.where(better, EASED * damping, RAISED * damping)
            damping = np.clip(damping, LEAST_DAMPING, MOST_DAMPING)
            going = _unfinished(square, starts)
            if step % PATIENCE == 0:
                going &= square < SLOWEST**2 * checked
                checked = square.copy()
            if not going.any():
                break
        return pose

    def _step(
        self,
        jacobian: FloatArray,
        residual: FloatArray,
        damping: FloatArray,
        pose: FloatArray,
        free: BoolArray,
    ) -> FloatArray:
        """Return the damped step of each case, (case, motor); none leaves its limits."""
        step = _damped(jacobian * free, residual, damping)
        outward = (step > 0.0) & (pose >= self.high - AT_LIMIT)
        outward |= (step < 0.0) & (pose <= self.low + AT_LIMIT)
        if (outward & free).any():
            step = _damped(jacobian * (free & ~outward)[:, None, :], residual, damping)
        largest = np.abs(step).max(axis=-1, keepdims=True)
        return np.asarray(step * np.minimum(1.0, LONGEST_STEP / np.maximum(largest, 1e-12)))


def tool_points(
    chain: SerialChain, q: FloatArray, pointer_m: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return the tool point and its Jacobian, and those of a second point along z of the tool.

    Joint values are (..., joint) [rad or m]; the second point is `pointer_m` away [m], 0: none.

    Returns:
        (..., 3 or 6) [m] and (..., 3 or 6, joint) [m/rad or m/m].
    """
    rotation, origin = chain.frames(q)
    axis, points = rotation[..., :-1, :, 2], [origin[..., -1, :]]
    if pointer_m > 0.0:
        points.append(points[0] + pointer_m * rotation[..., -1, :, 2])
    slopes = [cross(axis, point[..., None, :] - origin[..., :-1, :]) for point in points]
    slides = np.array([joint.prismatic for joint in chain.joints])
    if slides.any():
        slopes = [np.where(slides[:, None], axis, slope) for slope in slopes]
    jacobian = np.concatenate(slopes, axis=-1)
    return np.concatenate(points, axis=-1), np.swapaxes(jacobian, -1, -2)


def angle_between(axis: FloatArray, other: FloatArray) -> FloatArray:
    """Return the angle between unit vectors (..., 3), (...) [rad]."""
    return np.asarray(np.arccos(np.clip(np.sum(axis * other, axis=-1), -1.0, 1.0)))


def _unfinished(square: FloatArray, starts: int) -> BoolArray:
    """Return which cases continue, (case,), by their squared errors [m2]."""
    close = (square <= CLOSE_M**2).reshape(-1, starts)
    enough = close.mean(axis=1, keepdims=True) >= ENOUGH
    return np.asarray((~close & ~enough).ravel())


def _damped(jacobian: FloatArray, residual: FloatArray, damping: FloatArray) -> FloatArray:
    """Return J^T (J J^T + lambda I)^-1 r, (case, motor)."""
    turned = np.swapaxes(jacobian, -1, -2)
    square = jacobian @ turned
    diagonal = np.arange(square.shape[-1])
    square[:, diagonal, diagonal] += damping[:, None]
    return np.asarray((turned @ np.linalg.solve(square, residual[..., None]))[..., 0])


def usable_limits(robot: Robot) -> tuple[FloatArray, FloatArray]:
    """Return lowest and highest angle of each motor, (motor,) [rad]; half a turn where unlimited.

    Servo counts limit the angles further.
    """
    low, high = robot.limits.T.copy()
    low[~np.isfinite(low)], high[~np.isfinite(high)] = -UNLIMITED, UNLIMITED
    units = robot.profile.servo_units
    if units is not None:
        ends = np.sort(units.to_rad([units.low, units.high]))
        low, high = np.maximum(low, ends[0]), np.minimum(high, ends[1])
    return low, high


def feedback_factor(jacobian: FloatArray) -> FloatArray:
    """Return the convergence factor of corrections while motor k is stuck, (..., motor).

        rho_k = (J+)_k J_k

    With motor k held, nominal corrections dq = J+ r leave J_k (J+)_k r, a matrix of rank one: each
    step leaves rho_k of the last error. Near 1, feedback alone does not converge. The Jacobian is
    that of the tool position, (..., 3, motor) [m/rad].
    """
    inverse = np.linalg.pinv(jacobian)
    return np.asarray(np.einsum("...ka,...ak->...k", inverse, jacobian))
