"""A few runs at a time through MuJoCo: controls in, angles out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.physics.model import (
    PhysicsModel,
    PhysicsParameters,
    build_model,
    load_mujoco,
)
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import Drive

# The servos' set-points: references within the speed limit, filtered, at the fine step.


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


def filtered(
    reference: FloatArray, before: FloatArray, step: float, filter_s: FloatArray
) -> FloatArray:
    """Return references after each motor's first-order filter; exact for straight lines.

    Args:
        reference: (run, time, motor) [rad].
        before: What the filter has put out at the first instant, (run, motor) [rad].
        step: Time between instants [s].
        filter_s: Time constants, (motor,) [s].

    Returns:
        (run, time, motor) [rad], beginning with `before`.
    """
    from scipy.signal import lfilter

    out = np.empty_like(reference)
    out[:, 0] = before
    for k, tau in enumerate(filter_s):
        kept = np.exp(-step / tau)
        new = 1.0 - (1.0 - kept) * tau / step
        old = (1.0 - kept) * tau / step - kept
        memory = old * reference[:, :1, k] + kept * before[:, k, None]
        out[:, 1:, k], _ = lfilter([new, old], [1.0, -kept], reference[:, 1:, k], axis=1, zi=memory)
    return out


# Where the arm rests: servo and flex balance the weight, the gears' friction is relaxed.

ITERATIONS = 200
AT_REST_RAD = 1e-13


def rest_state(
    model: PhysicsModel,
    data: Any,
    parameters: PhysicsParameters,
    setpoint: FloatArray,
    strength: FloatArray,
) -> FloatArray:
    """Return the full physics state of the arm at rest.

    Args:
        model: The model of the run.
        data: A `mujoco.MjData` of it, overwritten.
        parameters: The motors.
        setpoint: Set-points in the physical sense, (motor,) [rad].
        strength: Share of its stiffness that each servo has, (motor,).

    Returns:
        (state,), as `mujoco.rollout` takes it.
    """
    mujoco = load_mujoco()
    give_drive = 1.0 / (strength * np.array([motor.stiffness for motor in parameters.motors]))
    give_flex = 1.0 / np.array([motor.flex_stiffness for motor in parameters.motors])
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


SAMPLES_AT_ONCE = 250
"""Bounds what is in memory: states and controls of 64 runs at two steps each take about 10 MB."""


@dataclass
class Arms:
    """Arms between two stretches of a simulation.

    Attributes:
        models: The model of each.
        data: Scratch of MuJoCo, one for each thread.
        pool: A `mujoco.rollout.Rollout`.
        state: Their full physics state, (run, state).
        setpoint: Output of their servos' filters, (run, motor) [rad].
    """

    models: list[PhysicsModel]
    data: list[Any]
    pool: Any
    state: FloatArray
    setpoint: FloatArray


@dataclass(frozen=True)
class Batch:
    """How runs are simulated.

    Attributes:
        robot: The robot.
        parameters: Its motors and gears.
        grid_step: Step of the caller's time grid [s].
        substeps: Steps of the simulation in each of these.
    """

    robot: Robot
    parameters: PhysicsParameters
    grid_step: float
    substeps: int

    @property
    def step(self) -> float:
        """Step of the simulation [s]."""
        return self.grid_step / self.substeps

    def run(self, drive: Drive, pool: Any, threads: int, out: FloatArray) -> None:
        """Simulate runs.

        Args:
            drive: What the motors of these runs are told, and what hampers them.
            pool: A `mujoco.rollout.Rollout`.
            threads: How many threads it has, 1 for none.
            out: Filled with the output sides' angles, physical sense, (run, time, motor) [rad].

        Raises:
            InputError: If the simulation becomes unstable.
        """
        reference = self.limited(drive.reference * self.robot.sense)
        strength = strength_of(drive)
        arms = self.at_rest(reference[:, 0], strength[:, 0], drive.payload, pool, threads)
        out[:, 0] = self.angle(arms)
        for part in chunks(out.shape[1] - 1, SAMPLES_AT_ONCE):
            span = slice(part.start, part.stop + 1)
            held = None if drive.held is None else drive.held[:, part]
            out[:, part.start + 1 : part.stop + 1] = self.advance(
                arms, reference[:, span], strength[:, span], held
            )

    def limited(self, reference: FloatArray) -> FloatArray:
        """Return references (run, time, motor) [rad] that are no faster than the motors."""
        speed = np.array([motor.speed_limit for motor in self.robot.motors])
        return limit_speed(reference, self.grid_step, speed)

    def at_rest(
        self,
        reference: FloatArray,
        strength: FloatArray,
        payload: FloatArray | None,
        pool: Any,
        threads: int,
    ) -> Arms:
        """Return arms at rest where servos and flex carry their weight.

        Args:
            reference: Where they are told to stand, physical sense, (run, motor) [rad].
            strength: Shares of their stiffness that the servos have, (run, motor).
            payload: Mass at the tool points, (run,) [kg]; None: none.
            pool: A `mujoco.rollout.Rollout`.
            threads: How many threads it has, 1 for none.
        """
        mujoco = load_mujoco()
        models = self._models(payload, len(reference))
        data = [mujoco.MjData(models[0].compiled) for _ in range(threads)]
        state = np.array(
            [
                rest_state(model, data[0], self.parameters, reference[i], strength[i])
                for i, model in enumerate(models)
            ]
        )
        return Arms(models, data, pool, state, reference)

    def advance(
        self, arms: Arms, reference: FloatArray, strength: FloatArray, held: BoolArray | None
    ) -> FloatArray:
        """Move arms on and return their output sides' angles, (run, time, motor) [rad].

        Args:
            arms: The arms; their state is moved on.
            reference: References at both ends of every sample, (run, time + 1, motor) [rad].
            strength: Shares of their stiffness that the servos have, like `reference`.
            held: Whether gears are held, (run, time, motor).

        Raises:
            InputError: If the simulation becomes unstable.
        """
        control, arms.setpoint = self._control(reference, strength, held, arms.setpoint)
        compiled = [model.compiled for model in arms.models]
        states, _ = arms.pool.rollout(compiled, arms.data, arms.state, control)
        _check_warnings(arms.data, self.step)
        arms.state = states[:, -1].copy()
        return self._angle(arms.models[0], states[:, self.substeps - 1 :: self.substeps])

    def angle(self, arms: Arms) -> FloatArray:
        """Return the angles at which arms stand, physical sense, (run, motor) [rad]."""
        return self._angle(arms.models[0], arms.state[:, None])[:, 0]

    def _models(self, payload: FloatArray | None, runs: int) -> list[PhysicsModel]:
        masses = np.zeros(runs) if payload is None else payload
        unique, which = np.unique(masses, return_inverse=True)
        models = [
            build_model(self.robot, self.parameters, self.step, float(mass)) for mass in unique
        ]
        return [models[i] for i in which]

    def _angle(self, model: PhysicsModel, states: FloatArray) -> FloatArray:
        """Return the output sides' angles, (run, time, motor), of states (run, time, state)."""
        before = 1  # a state begins with the time
        return states[..., before + model.drive] + states[..., before + model.flex]

    def _control(
        self,
        reference: FloatArray,
        strength: FloatArray,
        held: BoolArray | None,
        setpoint: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Return controls (run, step, 3 * motor) and the filters' output after them (run, motor).

        Args:
            reference: References at both ends of every sample, (run, time + 1, motor) [rad].
            strength: Shares of their stiffness that the servos have, like `reference`.
            held: Whether gears are held, (run, time, motor).
            setpoint: Output of the filters at the first of these samples, (run, motor) [rad].
        """
        stiffness, derivative, filter_s = (
            np.array([getattr(motor, name) for motor in self.parameters.motors])
            for name in ("stiffness", "derivative", "filter_s")
        )
        fine = refine(reference, self.substeps)
        followed = filtered(fine, setpoint, self.step, filter_s)
        share = refine(strength, self.substeps)[:, :-1]
        control = np.zeros((*share.shape[:2], 3, share.shape[2]))
        if held is not None:  # the servo would only push against the brake
            brake = np.repeat(held, self.substeps, axis=1)
            control[:, :, 2] = brake
            share = np.where(brake, 0.0, share)
        speed = (fine - followed)[:, :-1] / filter_s
        control[:, :, 0] = share * (stiffness * followed[:, :-1] + derivative * speed)
        control[:, :, 1] = share
        return control.reshape(*control.shape[:2], -1), followed[:, -1]


def chunks(count: int, size: int) -> Iterator[slice]:
    """Return slices of at most `size` that cover `count`."""
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def strength_of(drive: Drive) -> FloatArray:
    """Return the share of its stiffness that each servo has, (run, time, motor)."""
    if drive.weakness is None:
        return np.ones_like(drive.reference)
    return 1.0 - drive.weakness


def _check_warnings(data: list[Any], step: float) -> None:
    if any(warning.number for thread in data for warning in thread.warning):
        raise InputError(
            f"the physics engine became unstable at a step of {step} s. Give a smaller step_s, or "
            "parameters with more inertia or less stiffness."
        )
