"""Where the arm rests: servo and flex balance the weight, the gears' friction is relaxed."""

from __future__ import annotations

from typing import Any

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.digital_model.physics.extra import load_mujoco
from failuretwin.digital_model.physics.model import PhysicsModel
from failuretwin.digital_model.physics.parameters import PhysicsParameters

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
