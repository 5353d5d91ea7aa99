"""The physics engine: many runs of a robot by MuJoCo, independent of the inference."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import numpy as np

from failuretwin.core.config import Bounded, Bounds
from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.physics.arm import load_mujoco
from failuretwin.digital_model.physics.model import PhysicsModel, build_model
from failuretwin.digital_model.physics.motors import (
    MotorPhysics,
    PhysicsParameters,
    default_parameters,
    load_parameters,
)
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.servo import first_order_lag
from failuretwin.digital_model.twin import Drive, uniform_step

STEP_S = 0.005
"""Default step [s]; for its error see docs/generation.md#servo-engine-and-physics-engine."""
RUNS_AT_ONCE = 64
SAMPLES_AT_ONCE = 250
"""Limits memory: states and controls of 64 runs at two steps each take about 10 MB."""
WEAKEST = 0.99
"""Largest weakness; a weaker servo does not carry the arm."""
ITERATIONS = 200
AT_REST_RAD = 1e-13


@dataclass(frozen=True)
class PhysicsEngine(Bounded):
    """Rigid-body dynamics with servos, sticking gears and flexing joints.

    Stiffness is the engine's own: `Drive.compliance` is ignored. A run depends neither on the runs
    beside it nor on the number of threads, bit for bit.

    Attributes:
        robot: The robot.
        parameters: Its motors and gears; None: those of its profile, or ones derived from its URDF.
        threads: Number of threads.
        step_s: Largest time step [s]; a whole number of steps makes up a step of the time grid.
    """

    robot: Robot
    parameters: PhysicsParameters | None = None
    threads: Annotated[int, Bounds(1)] = 1
    step_s: Annotated[float, Bounds(1e-9)] = STEP_S

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.parameters is not None:
            self.parameters.check_fit(self.robot)

    @property
    def name(self) -> str:
        """Name on the command line."""
        return "physics"

    @cached_property
    def motors(self) -> tuple[MotorPhysics, ...]:
        """Simulated motors and gears."""
        given = self.parameters or load_parameters(self.robot)
        return (given or default_parameters(self.robot)).motors

    def figures(self, name: str) -> FloatArray:
        """Return one parameter of every motor, (motor,)."""
        return np.array([getattr(motor, name) for motor in self.motors])

    def angles(self, drive: Drive, time: FloatArray) -> FloatArray:
        """Return the angles of the output sides, (run, time, motor) [rad], log's sense.

        The arm starts at rest, with servos and flex carrying its weight.

        Args:
            drive: References and faults of the motors. A held motor stands still from the sample
                where the hold begins to the one after it ends. Weakness reduces the servo's torque
                at any error by the same share; the largest torque stays.
            time: Uniform grid, (time,) [s].
        """
        mujoco = load_mujoco()
        _check(drive, len(time), len(self.robot.motors))
        step, reference = uniform_step(time), drive.reference
        payload = np.zeros(len(reference)) if drive.payload is None else drive.payload
        weakness = np.zeros_like(reference) if drive.weakness is None else drive.weakness
        out = np.empty(reference.shape)
        with mujoco.rollout.Rollout(nthread=0 if self.threads == 1 else self.threads) as pool:
            for rows in _chunks(len(out), RUNS_AT_ONCE):
                weak = weakness[rows]
                arms = LiveArms(self, reference[rows, 0], step, payload[rows], weak[:, 0], pool)
                held = None if drive.held is None else drive.held[rows, :-1]
                out[rows, 0] = arms.angle
                out[rows, 1:] = arms.follow(reference[rows, 1:], held, weak[:, 1:])
        return out


class LiveArms:
    """Arms that start at rest and follow references given stretch by stretch, all in step.

    Consecutive stretches give the same angles as one run of the engine. Angles of the public
    interface are in the log's sense, those of the private one in the physical sense.

    Args:
        engine: Robot, motors and step; without `pool` its threads are not used.
        reference: Angle of each motor at the start, (arm, motor) [rad].
        step_s: Time step of the references [s].
        payload: Mass at the tool points, (arm,) [kg].
        weakness: Share of its stiffness that each motor has lost, (arm, motor); None: none.
        pool: A `mujoco.rollout.Rollout` with the engine's threads; None: one of its own.
    """

    def __init__(
        self,
        engine: PhysicsEngine,
        reference: FloatArray,
        step_s: float,
        payload: FloatArray,
        weakness: FloatArray | None = None,
        pool: Any = None,
    ) -> None:
        mujoco = load_mujoco()
        self._engine, self._grid_step, self._sense = engine, step_s, engine.robot.sense
        self._pool = mujoco.rollout.Rollout(nthread=0) if pool is None else pool
        self._substeps = max(1, int(np.ceil(step_s / engine.step_s - 1e-9)))
        self._step = step_s / self._substeps
        masses, which = np.unique(payload, return_inverse=True)
        models = [build_model(engine.robot, engine.motors, self._step, float(m)) for m in masses]
        self._models = [models[i] for i in which]
        threads = 1 if pool is None else engine.threads
        self._data = [mujoco.MjData(models[0].compiled) for _ in range(threads)]
        self._setpoint = self._last = reference * self._sense
        self._strength = _strength(reference, weakness)
        each = zip(self._models, self._setpoint, self._strength, strict=True)
        self._state = np.array([self._rest_state(*of_arm) for of_arm in each])

    @property
    def angle(self) -> FloatArray:
        """Angles of the output sides, (arm, motor) [rad]."""
        return self._angle(self._state) * self._sense

    def follow(
        self, reference: FloatArray, held: BoolArray | None, weakness: FloatArray | None
    ) -> FloatArray:
        """Follow references and return the output sides' angles at the same instants.

        Args:
            reference: References of the servos from one step after the last instant on,
                (arm, time, motor) [rad].
            held: Whether gears are held on the way there, (arm, time, motor); None: never.
            weakness: Share of its stiffness that each motor has lost, (arm, time, motor); None:
                none.

        Returns:
            (arm, time, motor) [rad].
        """
        limited = np.concatenate([self._last[:, None], reference * self._sense], axis=1)
        speed = np.array([motor.speed_limit for motor in self._engine.robot.motors])
        limited = limit_speed(limited, self._grid_step, speed)
        strength = np.concatenate([self._strength[:, None], _strength(reference, weakness)], axis=1)
        self._last, self._strength = limited[:, -1], strength[:, -1]
        out = np.empty_like(reference)
        for part in _chunks(out.shape[1], SAMPLES_AT_ONCE):
            span = slice(part.start, part.stop + 1)
            brake = None if held is None else held[:, part]
            out[:, part] = self._advance(limited[:, span], brake, strength[:, span])
        return out * self._sense

    def _rest_state(
        self, model: PhysicsModel, setpoint: FloatArray, strength: FloatArray
    ) -> FloatArray:
        """Return the full state (state,) of an arm at rest: servo and flex balance the weight.

        The gears' friction is relaxed. Set-points [rad] and strengths are (motor,).
        """
        data = self._data[0]
        mujoco = load_mujoco()
        give_drive = 1.0 / (strength * self._engine.figures("stiffness"))
        give_flex = 1.0 / self._engine.figures("flex_stiffness")
        mujoco.mj_resetData(model.compiled, data)
        load, before, share = np.zeros_like(setpoint), np.zeros_like(setpoint), 1.0
        for _ in range(ITERATIONS):
            data.qpos[model.drive] = setpoint - give_drive * load
            data.qpos[model.flex] = -give_flex * load
            mujoco.mj_forward(model.compiled, data)
            change = data.qfrc_bias[model.drive] - load
            if np.abs(change * (give_drive + give_flex)).max() < AT_REST_RAD:
                break
            # Soft servos give way so far that the load swings to and fro: smaller steps converge.
            share *= 0.5 if change @ before < -0.5 * before @ before else 1.0
            load, before = load + share * change, change
        sticks = model.friction >= 0
        data.plastic[model.friction[sticks]] = data.qpos[model.drive[sticks]]
        full = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.empty(mujoco.mj_stateSize(model.compiled, full))
        mujoco.mj_getState(model.compiled, data, state, full)
        return state

    def _angle(self, states: FloatArray) -> FloatArray:
        """Return the output sides' angles, (..., motor), of states (..., state)."""
        model, before = self._models[0], 1  # a state begins with the time
        return states[..., before + model.drive] + states[..., before + model.flex]

    def _advance(
        self, reference: FloatArray, held: BoolArray | None, strength: FloatArray
    ) -> FloatArray:
        """Return angles (run, time, motor) [rad] for references at both ends of every sample."""
        control = self._control(reference, held, strength)
        compiled = [model.compiled for model in self._models]
        states, _ = self._pool.rollout(compiled, self._data, self._state, control)
        if any(warning.number for thread in self._data for warning in thread.warning):
            raise InputError(
                f"the physics engine became unstable at a step of {self._step} s. Give a smaller "
                "step_s, or parameters with more inertia or less stiffness."
            )
        self._state = states[:, -1].copy()
        return self._angle(states[:, self._substeps - 1 :: self._substeps])

    def _control(
        self, reference: FloatArray, held: BoolArray | None, strength: FloatArray
    ) -> FloatArray:
        """Return controls (run, step, 3 * motor) and move the set-points on."""
        names = ("stiffness", "derivative", "filter_s")
        stiffness, derivative, filter_s = (self._engine.figures(name) for name in names)
        fine = refine(reference, self._substeps)
        followed = np.empty_like(fine)
        for k, tau in enumerate(filter_s):
            before = self._setpoint[:, k]
            followed[..., k] = first_order_lag(fine[..., k], before, self._step, tau)
        self._setpoint = followed[:, -1]
        share = refine(strength, self._substeps)[:, :-1]
        control = np.zeros((*share.shape[:2], 3, share.shape[2]))
        if held is not None:  # the servo would only push against the brake
            brake = np.repeat(held, self._substeps, axis=1)
            control[:, :, 2] = brake
            share = np.where(brake, 0.0, share)
        speed = (fine - followed)[:, :-1] / filter_s
        control[:, :, 0] = share * (stiffness * followed[:, :-1] + derivative * speed)
        control[:, :, 1] = share
        return control.reshape(*control.shape[:2], -1)


def limit_speed(reference: FloatArray, step: float, speed: FloatArray) -> FloatArray:
    """Return references that follow the given ones within a speed limit.

    References are (run, time, motor) [rad], sampled every `step` [s]; speeds are (motor,) [rad/s].
    """
    largest = speed * step * (1.0 + 1e-9)  # a ramp at exactly this speed is left as it is
    limited = reference.copy()
    # Only runs that ask for more are touched, so that none depends on the others by rounding.
    fast = (np.abs(np.diff(reference, axis=1)) > largest).any(axis=(1, 2))
    for i in range(1, reference.shape[1]):
        change = np.clip(reference[fast, i] - limited[fast, i - 1], -largest, largest)
        limited[fast, i] = limited[fast, i - 1] + change
    return limited


def refine(samples: FloatArray, substeps: int) -> FloatArray:
    """Return `samples` (run, time, motor) with straight lines between, `substeps` times finer.

    The result has (time - 1) * substeps + 1 instants.
    """
    share = (np.arange(substeps) / substeps)[:, None]
    low, high = samples[:, :-1, None], samples[:, 1:, None]
    fine = low + share * (high - low)
    fine = fine.reshape(len(samples), -1, samples.shape[-1])
    return np.concatenate([fine, samples[:, -1:]], axis=1)


def _chunks(count: int, size: int) -> Iterator[slice]:
    """Return slices of at most `size` that cover `count`."""
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def _strength(reference: FloatArray, weakness: FloatArray | None) -> FloatArray:
    """Return the share of its stiffness that each servo has, of the shape of `reference`."""
    return np.ones_like(reference) if weakness is None else 1.0 - weakness


def _check(drive: Drive, times: int, motors: int) -> None:
    shape = drive.reference.shape
    if len(shape) != 3 or shape[1:] != (times, motors):
        raise InputError(
            f"`reference` has shape {shape}, expected (run, {times} times, {motors} motors)."
        )
    if not np.isfinite(drive.reference).all():
        raise InputError("`reference` holds values that are not finite. Hold the last angle.")
    rows = (("held", shape, 1.0), ("weakness", shape, WEAKEST), ("payload", shape[:1], np.inf))
    for name, expected, highest in rows:
        values = getattr(drive, name)
        if values is not None and values.shape != expected:
            raise InputError(f"`{name}` has shape {values.shape}, expected {expected}.")
        if values is not None and not np.all(
            (values >= 0) & (values <= highest) & (values < np.inf)
        ):
            raise InputError(f"`{name}` must lie between 0 and {highest}.")
