"""Which runs had better not teach the twin: they look faulty even to a doubtful eye."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.decision.bayes import BayesDiagnoser
from failuretwin.digital_model.imperfections import (
    GENERIC_SCATTER_RAD,
    Imperfections,
    LostCommand,
)
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr

MOST_LOST = 0.1
"""A healthy motor loses at most this share of its commands, however often these logs did."""


def suspicion(runs: xr.Dataset, robot: Robot, learned: Imperfections) -> FloatArray:
    """Return the probability that each run is faulty, (run,); 0 where nothing can be told.

    A fit to faulty runs takes their errors for scatter and their stuck motors for lost commands,
    so neither is believed beyond what healthy arms do.

    Args:
        runs: The runs that something was learned from.
        robot: The robot.
        learned: What was learned from them.
    """
    settling = learned.settling
    if settling is not None:
        scatter = tuple(min(value, GENERIC_SCATTER_RAD) for value in settling.scatter)
        settling = replace(settling, scatter=scatter)
    bounded = replace(
        learned,
        settling=settling,
        lost_commands=tuple(_bounded(entry) for entry in learned.lost_commands),
    )
    diagnoses = BayesDiagnoser(DigitalTwin(robot), imperfections=bounded).diagnose(runs)
    return np.array([0.0 if d.undecided else 1.0 - d.posterior["healthy"] for d in diagnoses])


def _bounded(entry: LostCommand) -> LostCommand:
    return LostCommand(
        entry.motors, min(entry.rate, MOST_LOST), min(entry.rate_when_late, 2.0 * MOST_LOST)
    )
