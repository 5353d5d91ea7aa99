"""The motions of the imperfect healthy robot, for many runs at once; all chance is drawn before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.disturbances import Disturbances


def delay_commands(movements: Movements, late: FloatArray) -> Movements:
    """Return the movements as commanded when each late start also delays all that follow.

    A stalled bus holds up the sender: the command keeps its early stamp, the next one is sent a
    full period after the late start.

    Args:
        movements: The undisturbed schedule.
        late: Late start of each movement, (run, movement) [s].
    """
    before = np.cumsum(late, axis=1) - late
    return replace(movements, start=movements.start + before)


def actual_movements(movements: Movements, chance: Disturbances) -> Movements:
    """Return the movements that the motors really make, without gravity sag.

    Args:
        movements: As commanded (after any fault that alters targets).
        chance: Disturbances of the same runs.

    Returns:
        Movements with lost commands, bias, friction and scatter in their targets, and with late
        starts, delay and early ramp ends in their times.
    """
    here = movements.initial + chance.bias + chance.scatter[:, 0]
    initial = here
    target = np.empty_like(movements.target)
    commanded = movements.initial
    for m in range(target.shape[1]):
        wanted = movements.target[:, m]
        short = chance.friction * np.sign(wanted - commanded)
        settled = wanted + chance.bias - short + chance.scatter[:, 1 + m]
        target[:, m] = np.where(chance.lost[:, m], here, settled)
        commanded = np.where(chance.lost[:, m], commanded, wanted)
        here = target[:, m]
    return Movements(
        initial=initial,
        target=target,
        ramp_duration=movements.ramp_duration * (1.0 - chance.shortening[:, None, None]),
        start=movements.start + chance.late + chance.delay[:, None],
    )


def lagged(reference: FloatArray, time: FloatArray, lag: FloatArray) -> FloatArray:
    """Return references behind a first-order lag, exact for lines between samples.

    Args:
        reference: (run, time, motor) [rad], at rest at its first value.
        time: Uniform grid, (time,) [s].
        lag: Time constant of each run, (run,) [s]; 0 leaves a run as it is.
    """
    from scipy.signal import lfilter

    if not lag.any():
        return reference
    out = reference.copy()
    step = time[1] - time[0]
    for run in np.flatnonzero(lag):
        kept = np.exp(-step / lag[run])
        mean = lag[run] / step * (1.0 - kept)
        moved = reference[run] - reference[run, :1]
        out[run] = reference[run, :1] + lfilter(
            [1.0 - mean, mean - kept], [1.0, -kept], moved, axis=0
        )
    return out
