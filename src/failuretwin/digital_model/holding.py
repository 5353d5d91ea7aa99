"""Motors held by their gear: they keep their angle, and catch up once they are let go."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray


def hold(
    position: FloatArray, held: BoolArray | None, time: FloatArray, speed_limit: FloatArray
) -> FloatArray:
    """Return the angles of motors that are held at times.

    While held, a motor keeps the angle that it has at the first such sample. After that it makes
    for the free motion at its speed limit, and follows it once it has caught up.

    Args:
        position: Free motion, (run, time, motor) [rad].
        held: When a motor is held, (run, time, motor); None: never.
        time: Uniform grid, (time,) [s].
        speed_limit: Largest speed of each motor, (motor,) [rad/s].

    Returns:
        (run, time, motor) [rad]; the given array where nothing is held.
    """
    if held is None:
        return position
    first = np.argmax(held, axis=1)[:, None]
    angle = np.take_along_axis(position, first, axis=1)
    followed = np.where(held, angle, position)
    run, motor = np.nonzero((held[:, :-1] & ~held[:, 1:]).any(axis=1))
    if len(run):
        reach = speed_limit[motor] * (time[-1] - time[0]) / (len(time) - 1)
        followed[run, :, motor] = _let_go(position[run, :, motor].T, held[run, :, motor].T, reach).T
    return followed


def _let_go(position: FloatArray, held: BoolArray, reach: FloatArray) -> FloatArray:
    """Return the angles (time, case) of motors that are let go at least once.

    Args:
        position: Free motion, (time, case) [rad].
        held: When a motor is held, (time, case).
        reach: Farthest way in one step, (case,) [rad].
    """
    followed = np.empty_like(position)
    here = followed[0] = position[0]
    behind = np.zeros(len(reach), dtype=bool)
    for k in range(1, len(position)):
        stays = held[k] & held[k - 1]
        near = np.clip(position[k], here - reach, here + reach)
        here = np.where(stays, here, np.where(behind, near, position[k]))
        behind = stays | (behind & (here != position[k]))
        followed[k] = here
    return followed
