"""Runs in which nothing is left to chance: the signature that a fault leaves on the tool."""

from __future__ import annotations

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.generate import drive_of
from failuretwin.digital_model.disturbances import draw_disturbances, stack
from failuretwin.digital_model.nonidealities import Imperfections, deterministic
from failuretwin.digital_model.twin import DigitalTwin, ServoEngine
from failuretwin.failure_behavior.injection import Injection


def noise_free_path(
    twin: DigitalTwin,
    imperfections: Imperfections,
    movements: Movements,
    time: FloatArray,
    injection: Injection,
) -> FloatArray:
    """Return the path of the tool with faults, and without scatter, losses, stalls and glitches.

    Args:
        twin: Digital twin of the robot.
        imperfections: How the healthy robot differs from it.
        movements: As commanded.
        time: Uniform grid, (time,) [s].
        injection: Faults of the runs.

    Returns:
        (run, time, axis) [m].
    """
    runs, count = movements.start.shape
    rng = np.random.default_rng(0)  # asked, but nothing that it says counts
    luck = draw_disturbances(deterministic(imperfections), twin.robot, count, 0.0, rng)
    drive = drive_of(movements, movements.reference(time), time, injection, stack([luck] * runs))
    return twin.path(ServoEngine(twin.robot).angles(drive, time))
