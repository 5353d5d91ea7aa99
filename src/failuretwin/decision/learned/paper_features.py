"""The paper's two feature sets: every tenth of 1000 samples, over the first ten seconds."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.decision.learned.signals import Signals
from failuretwin.digital_model.twin import DigitalTwin

POINTS = 100
"""Points of a run that a network sees."""
PERIOD_S = 0.1
"""Time from one point to the next [s]: every tenth sample of the published 100 Hz."""


def original_features(twin: DigitalTwin, signals: Signals) -> FloatArray:
    """Return commands [rad] and measured tool position [m], (run, point, motor + axis)."""
    del twin  # these features know nothing of the robot
    command, measured = _at_points(signals)
    return np.concatenate([command, measured], axis=-1)


def augmented_features(twin: DigitalTwin, signals: Signals) -> FloatArray:
    """Return desired tool position and what is measured beyond it, (run, point, 6) [m].

    The desired position is the forward kinematics of the command, without any servo.
    """
    command, measured = _at_points(signals)
    desired = twin.path(command)
    return np.concatenate([desired, measured - desired], axis=-1)


def _at_points(signals: Signals) -> tuple[FloatArray, FloatArray]:
    """Return commands (run, point, motor) and filled readings (run, point, axis).

    Where a run ends early, its last values are held.
    """
    stride = max(1, round(PERIOD_S / signals.step))
    index = np.minimum(stride * np.arange(POINTS), len(signals.time) - 1)
    seen, at = signals.seen, signals.time[index]
    measured = np.zeros((len(signals.command), POINTS, 3))
    for run, known in enumerate(seen):
        if known.all():
            measured[run] = signals.measured[run, index]
        elif known.any():
            for axis in range(3):
                measured[run, :, axis] = np.interp(
                    at, signals.time[known], signals.measured[run, known, axis]
                )
    return signals.command[:, index], measured
