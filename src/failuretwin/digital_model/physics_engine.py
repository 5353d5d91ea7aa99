"""The physics engine: many runs of a robot by MuJoCo, a motion that no inference of ours owns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.physics_model import (
    MotorPhysics,
    PhysicsModel,
    PhysicsParameters,
    build_model,
    default_parameters,
    load_mujoco,
    load_parameters,
)
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.servo import first_order_lag
from failuretwin.digital_model.twin import Drive, uniform_step

STEP_S = 0.005
"""Default step [s]; see docs/generation.md#servo-engine-and-physics-engine for its error."""
RUNS_AT_ONCE = 64
SAMPLES_AT_ONCE = 250
"""Bounds what is in memory: states and controls of 64 runs at two steps each take about 10 MB."""
WEAKEST = 0.99
"""Largest weakness; a servo with less left does not carry the arm."""
ITERATIONS = 200
AT_REST_RAD = 1e-13


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

    @cached_property
    def motors(self) -> tuple[MotorPhysics, ...]:
        """Motors and gears that it simulates."""
        given = self.parameters or load_parameters(self.robot)
        return (given or default_parameters(self.robot)).motors

    def figures(self, name: str) -> FloatArray:
        """Return one figure of every motor, (motor,)."""
        return np.array([getattr(motor, name) for motor in self.motors])

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
        _check(drive, len(time), len(self.robot.motors))
        step = uniform_step(time)
        reference, strength = drive.reference * self.robot.sense, _strength(drive)
        payload = np.zeros(len(reference)) if drive.payload is None else drive.payload
        out = np.empty(reference.shape)
        with mujoco.rollout.Rollout(nthread=0 if self.threads == 1 else self.threads) as pool:
            for rows in _chunks(len(out), RUNS_AT_ONCE):
                told, share = reference[rows], strength[rows]
                arms = _Arms(self, step, told[:, 0], share[:, 0], payload[rows], pool)
                held = None if drive.held is None else drive.held[rows, :-1]
                out[rows, 0] = arms.angle
                out[rows, 1:] = arms.follow(told[:, 1:], held, share[:, 1:])
        return out * self.robot.sense


class LiveArms:
    """Arms at rest that then follow whatever they are told next, all in step.

    Stretches that follow each other give what one run of the engine would give. Angles are in the
    log's sense.

    Args:
        engine: The engine; it simulates on one thread.
        reference: Where each arm stands, (arm, motor) [rad].
        step_s: Step of the references to come [s].
        payload: Mass at the tool points, (arm,) [kg].

    Raises:
        InputError: If mujoco is missing.
    """

    def __init__(
        self, engine: PhysicsEngine, reference: FloatArray, step_s: float, payload: FloatArray
    ) -> None:
        self._sense = engine.robot.sense
        pool = load_mujoco().rollout.Rollout(nthread=0)
        alone, stand = replace(engine, threads=1), reference * self._sense
        self._arms = _Arms(alone, step_s, stand, np.ones_like(stand), payload, pool)

    @property
    def angle(self) -> FloatArray:
        """Where the arms stand, (arm, motor) [rad]."""
        return self._arms.angle * self._sense

    def follow(
        self, reference: FloatArray, held: BoolArray | None, weakness: FloatArray | None
    ) -> FloatArray:
        """Move on and return the angles at the same instants, (arm, time, motor) [rad].

        Args:
            reference: What the servos are told, one step after where the arms stand and so on,
                (arm, time, motor) [rad].
            held: Whether the gears are held, (arm, time, motor); None: never.
            weakness: Share of its stiffness that each motor has lost, (arm, time, motor); None:
                none.

        Raises:
            InputError: If the simulation becomes unstable.
        """
        strength = _strength(Drive(reference, weakness=weakness))
        return self._arms.follow(reference * self._sense, held, strength) * self._sense


class LiveArm:
    """One arm at rest that then follows whatever it is told next; see `LiveArms`.

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
        self._arms = LiveArms(engine, reference[None], step_s, np.array([payload]))

    @property
    def angle(self) -> FloatArray:
        """Where the arm stands, (motor,) [rad]."""
        return np.asarray(self._arms.angle[0])

    def follow(
        self, reference: FloatArray, held: BoolArray | None, weakness: FloatArray | None
    ) -> FloatArray:
        """Move on and return the angles at the same instants, (time, motor) [rad].

        Args:
            reference: What the servos are told, (time, motor) [rad].
            held: Whether the gears are held, (time, motor); None: never.
            weakness: Share of its stiffness that each motor has lost, (time, motor); None: none.

        Raises:
            InputError: If the simulation becomes unstable.
        """
        brake = None if held is None else held[None]
        weak = None if weakness is None else weakness[None]
        return np.asarray(self._arms.follow(reference[None], brake, weak)[0])


class _Arms:
    """Arms at rest that then follow whatever they are told next, in the physical sense.

    Args:
        engine: What moves them.
        grid_step: Step of the references to come [s].
        reference: Where they are told to stand, (run, motor) [rad].
        strength: Shares of their stiffness that the servos have, (run, motor).
        payload: Mass at the tool points, (run,) [kg].
        pool: A `mujoco.rollout.Rollout` with the threads of the engine.
    """

    def __init__(
        self,
        engine: PhysicsEngine,
        grid_step: float,
        reference: FloatArray,
        strength: FloatArray,
        payload: FloatArray,
        pool: Any,
    ) -> None:
        self._engine, self._grid_step, self._pool = engine, grid_step, pool
        self._substeps = max(1, int(np.ceil(grid_step / engine.step_s - 1e-9)))
        self._step = grid_step / self._substeps
        masses, which = np.unique(payload, return_inverse=True)
        models = [build_model(engine.robot, engine.motors, self._step, float(m)) for m in masses]
        self._models = [models[i] for i in which]
        mujoco = load_mujoco()
        self._data = [mujoco.MjData(models[0].compiled) for _ in range(engine.threads)]
        each = zip(self._models, reference, strength, strict=True)
        self._state = np.array([self._rest_state(*of_run) for of_run in each])
        self._setpoint = self._last = reference
        self._strength = strength

    def _rest_state(
        self, model: PhysicsModel, setpoint: FloatArray, strength: FloatArray
    ) -> FloatArray:
        """Return the full state (state,) of an arm at rest: servo and flex balance the weight.

        The gears' friction is relaxed. Set-points [rad] and strengths are those of each motor.
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

    @property
    def angle(self) -> FloatArray:
        """Where the output sides stand, (run, motor) [rad]."""
        return self._angle(self._state)

    def _angle(self, states: FloatArray) -> FloatArray:
        """Return the output sides' angles, (..., motor), of states (..., state)."""
        model, before = self._models[0], 1  # a state begins with the time
        return states[..., before + model.drive] + states[..., before + model.flex]

    def follow(
        self, reference: FloatArray, held: BoolArray | None, strength: FloatArray
    ) -> FloatArray:
        """Move on and return the output sides' angles at the same instants.

        Args:
            reference: What the servos are told from one step later on, (run, time, motor) [rad].
            held: Whether gears are held on the way there, (run, time, motor); None: never.
            strength: Shares of their stiffness that the servos have, like `reference`.

        Returns:
            (run, time, motor) [rad].

        Raises:
            InputError: If the simulation becomes unstable.
        """
        told = np.concatenate([self._last[:, None], reference], axis=1)
        speed = np.array([motor.speed_limit for motor in self._engine.robot.motors])
        told = limit_speed(told, self._grid_step, speed)
        strength = np.concatenate([self._strength[:, None], strength], axis=1)
        self._last, self._strength = told[:, -1], strength[:, -1]
        out = np.empty_like(reference)
        for part in _chunks(out.shape[1], SAMPLES_AT_ONCE):
            span = slice(part.start, part.stop + 1)
            brake = None if held is None else held[:, part]
            out[:, part] = self._advance(told[:, span], brake, strength[:, span])
        return out

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
    """Return references that chase the given ones no faster than each motor can.

    Args:
        reference: (run, time, motor) [rad].
        step: Time between samples [s].
        speed: Largest speed of each motor, (motor,) [rad/s].
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


def _strength(drive: Drive) -> FloatArray:
    """Return the share of its stiffness that each servo has, (..., time, motor)."""
    return np.ones_like(drive.reference) if drive.weakness is None else 1.0 - drive.weakness


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
