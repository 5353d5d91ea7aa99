"""The physics engine: many runs of a robot that no inference of ours owns."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.physics.batch import SAMPLES_AT_ONCE, Batch, chunks, strength_of
from failuretwin.digital_model.physics.model import (
    MotorPhysics,
    PhysicsParameters,
    arm_spec,
    load_mujoco,
    load_parameters,
)
from failuretwin.digital_model.robot import Motor, Robot
from failuretwin.digital_model.twin import Drive
from failuretwin.digital_model.urdf import read_urdf

# Motors and gears for a robot of which only URDF and profile are known: assumed, not measured.

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


STEP_S = 0.005
"""Default step [s]; see docs/engines.md for its error."""
RUNS_AT_ONCE = 64
WEAKEST = 0.99
"""Largest weakness; a servo with less left does not carry the arm."""


@dataclass(frozen=True)
class PhysicsEngine:
    """Moves a robot by rigid-body dynamics with servos, sticking gears and flexing joints.

    Stiffness is the engine's own: `Drive.compliance` is left aside. What a run does depends on
    neither the runs beside it nor the number of threads, bit for bit.

    Attributes:
        robot: The robot.
        parameters: Its motors and gears; None: those of its profile, or ones derived from its URDF.
        threads: Runs simulated side by side.
        step_s: Largest time step [s]; a whole number of steps makes up a step of the time grid.
    """

    robot: Robot
    parameters: PhysicsParameters | None = None
    threads: int = 1
    step_s: float = STEP_S

    def __post_init__(self) -> None:
        if self.threads < 1:
            raise InputError(f"threads is {self.threads}, expected 1 or more.")
        if not self.step_s > 0.0:
            raise InputError(f"step_s is {self.step_s}, expected a time above zero [s].")
        if self.parameters is not None:
            self.parameters.check_fit(self.robot)

    @property
    def name(self) -> str:
        """What the engine is called on the command line."""
        return "physics"

    def angles(self, drive: Drive, time: FloatArray) -> FloatArray:
        """Return the angles that the output sides take, (run, time, motor) [rad], log's sense.

        The arm starts at rest where servos and flex carry its weight.

        Args:
            drive: What the motors are told, and what hampers them. A motor that is held stands
                still from the sample where it begins to the one after it ends. Weakness takes
                the same share of the servo's torque at any error; the largest torque stays.
            time: Uniform grid, (time,) [s].

        Raises:
            InputError: If mujoco is missing, shapes do not fit, the grid is not uniform, or the
                step is too long for the stiffness of the robot.
        """
        mujoco = load_mujoco()
        batch = self.batch(_check(drive, time, len(self.robot.motors)))
        out = np.empty(drive.reference.shape)
        pool_size = 0 if self.threads == 1 else self.threads
        with mujoco.rollout.Rollout(nthread=pool_size) as pool:
            for rows in chunks(len(out), RUNS_AT_ONCE):
                batch.run(_rows(drive, rows), pool, self.threads, out[rows])
        return out * self.robot.sense

    def batch(self, grid_step: float) -> Batch:
        """Return how runs on a time grid with steps of `grid_step` [s] are simulated."""
        substeps = max(1, int(np.ceil(grid_step / self.step_s - 1e-9)))
        parameters = self.parameters or load_parameters(self.robot)
        return Batch(self.robot, parameters or default_parameters(self.robot), grid_step, substeps)


def _rows(drive: Drive, rows: slice) -> Drive:
    return replace(
        drive,
        reference=drive.reference[rows],
        held=None if drive.held is None else drive.held[rows],
        weakness=None if drive.weakness is None else drive.weakness[rows],
        payload=None if drive.payload is None else drive.payload[rows],
    )


def _check(drive: Drive, time: FloatArray, motors: int) -> float:
    """Return the step of the grid [s]."""
    shape = drive.reference.shape
    if len(shape) != 3 or shape[1:] != (len(time), motors):
        raise InputError(
            f"`reference` has shape {shape}, expected (run, {len(time)} times, {motors} motors)."
        )
    if not np.isfinite(drive.reference).all():
        raise InputError("`reference` holds values that are not finite. Hold the last angle.")
    if drive.held is not None:
        _check_values("held", drive.held, shape, highest=1.0)
    if drive.weakness is not None:
        _check_values("weakness", drive.weakness, shape, highest=WEAKEST)
    if drive.payload is not None:
        _check_values("payload", drive.payload, shape[:1], highest=np.inf)
    steps = np.diff(time)
    if len(steps) == 0 or steps.min() <= 0 or np.ptp(steps) > 1e-3 * steps.mean():
        raise InputError("`time` is not a uniform, increasing grid. Resample onto one.")
    return float((time[-1] - time[0]) / len(steps))


def _check_values(
    name: str, values: FloatArray | BoolArray, shape: tuple[int, ...], highest: float
) -> None:
    if values.shape != shape:
        raise InputError(f"`{name}` has shape {values.shape}, expected {shape}.")
    if not ((values >= 0) & (values <= highest) & np.isfinite(values)).all():
        raise InputError(f"`{name}` must lie between 0 and {highest}.")


# One arm of the physics engine that is moved on stretch by stretch, for as long as one likes.


class LiveArm:
    """An arm at rest that then follows whatever it is told next.

    Stretches that follow each other give what one run of the engine would give. Angles are in the
    log's sense.

    Args:
        engine: The engine; its threads are not used.
        reference: Where the arm stands, (motor,) [rad].
        step_s: Step of the references to come [s].
        payload: Mass at the tool point [kg].

    Raises:
        InputError: If mujoco is missing.
    """

    def __init__(
        self, engine: PhysicsEngine, reference: FloatArray, step_s: float, payload: float = 0.0
    ) -> None:
        self._batch = engine.batch(step_s)
        self._sense = engine.robot.sense
        self._last = (reference * self._sense)[None]
        pool = load_mujoco().rollout.Rollout(nthread=0)
        self._arms = self._batch.at_rest(
            self._last, np.ones_like(self._last), np.array([payload]), pool, 1
        )
        self._strength = np.ones_like(self._last)

    @property
    def angle(self) -> FloatArray:
        """Where the arm stands, (motor,) [rad]."""
        return self._batch.angle(self._arms)[0] * self._sense

    def follow(
        self, reference: FloatArray, held: BoolArray | None, weakness: FloatArray | None
    ) -> FloatArray:
        """Move on and return the angles at the same instants, (time, motor) [rad].

        Args:
            reference: What the servos are told, one step after where the arm stands and so on,
                (time, motor) [rad].
            held: Whether the gears are held, (time, motor); None: never.
            weakness: Share of its stiffness that each motor has lost, (time, motor); None: none.

        Raises:
            InputError: If the simulation becomes unstable.
        """
        told = np.concatenate([self._last, reference * self._sense])[None]
        limited = self._batch.limited(told)
        drive = Drive(reference[None], weakness=None if weakness is None else weakness[None])
        strength = np.concatenate([self._strength[None], strength_of(drive)], axis=1)
        self._last, self._strength = limited[:, -1], strength[:, -1]
        angles = np.empty_like(reference)
        for part in chunks(len(reference), SAMPLES_AT_ONCE):
            span = slice(part.start, part.stop + 1)
            brake = None if held is None else held[None, part]
            angles[part] = self._batch.advance(
                self._arms, limited[:, span], strength[:, span], brake
            )[0]
        return angles * self._sense
