"""The physics engine: many runs of a robot that no inference of ours owns."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.engine import Drive
from failuretwin.digital_model.physics.batch import Batch, chunks
from failuretwin.digital_model.physics.derived import default_parameters
from failuretwin.digital_model.physics.extra import load_mujoco
from failuretwin.digital_model.physics.parameters import PhysicsParameters, load_parameters
from failuretwin.digital_model.robot import Robot

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
