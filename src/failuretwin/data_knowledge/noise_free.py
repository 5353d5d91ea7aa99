"""Runs in which nothing is left to chance: the signature that a fault leaves on the tool."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.driving import drive_of
from failuretwin.digital_model.disturbances import draw_disturbances, stack
from failuretwin.digital_model.engine import ServoEngine
from failuretwin.digital_model.imperfections import Imperfections, Range
from failuretwin.digital_model.twin import DigitalTwin
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
    luck = draw_disturbances(without_chance(imperfections), twin.robot, count, 0.0, rng)
    drive = drive_of(movements, movements.reference(time), time, injection, stack([luck] * runs))
    return twin.path(ServoEngine(twin.robot).angles(drive, time))


def without_chance(imperfections: Imperfections) -> Imperfections:
    """Return imperfections that leave nothing to chance; ranges shrink to their middles."""
    timing, settling = imperfections.timing, imperfections.settling
    if settling is not None:
        settling = replace(settling, scatter=(0.0,) * len(settling.scatter))
    return replace(
        imperfections,
        settling=settling,
        timing=replace(
            timing,
            delay_s=_middle(timing.delay_s),
            lag_s=_middle(timing.lag_s),
            ramp_shortening=_middle(timing.ramp_shortening),
            late_rate=0.0,
        ),
        lost_commands=(),
        readings=None,
        variation=None,
    )


def _middle(ends: Range) -> Range:
    middle = 0.5 * (ends[0] + ends[1])
    return middle, middle
