"""Settled poses of healthy logs: what was commanded and where the tool came to rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.runs import truth_of
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.settings import InferenceSettings

if TYPE_CHECKING:
    import xarray as xr

FEWEST = 8
"""Settled poses below which no frame is fitted: with six numbers of the frame and three of the tool
that leaves one or two poses to tell a bad one by."""


@dataclass(frozen=True)
class Poses:
    """Where the tool rested.

    Attributes:
        target: Commanded angles, (pose, motor) [rad], log's sense.
        point: Settled tool positions, (pose, 3) [m], in the sensor's frame.
    """

    target: FloatArray
    point: FloatArray

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.target)

    def __getitem__(self, kept: IntArray | slice) -> Poses:
        """Return some of the poses."""
        return Poses(self.target[kept], self.point[kept])

    def spread(self, count: int) -> Poses:
        """Return as many of the poses at most, evenly over all."""
        if len(self) <= count:
            return self
        return self[np.rint(np.linspace(0, len(self) - 1, count)).astype(int)]


def settled_poses(runs: xr.Dataset, robot: Robot) -> Poses:
    """Return the settled poses of healthy runs; runs that are labelled faulty are left out.

    Nothing but commands and tool positions is read.

    Raises:
        InputError: If there are too few.
    """
    truth = truth_of(runs)
    if truth is not None:
        runs = runs.isel(run=[i for i, fault in enumerate(truth) if fault == "healthy"])
    count = 0
    if runs.sizes["run"]:
        settled = Evidence(runs, InferenceSettings.of(robot)).sound.settled
        usable = settled.usable
        count = int(usable.sum())
    if count < FEWEST:
        unknowns = 4 * len(robot.motors) + 3
        raise InputError(
            f"the logs hold {count} poses in which a healthy arm rests, expected {FEWEST} at least "
            f"for frame and tool point, and {2 * unknowns} or more for the geometry of "
            f"{len(robot.motors)} joints. Let the arm rest in more poses, all over its range."
        )
    return Poses(settled.movements.target[usable], settled.point[usable])
