"""How fast and how far healthy motors may change: what tells wear from a fault that grows.

Section: docs/inference.md#lives
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.digital_model.settling import largest_load
from failuretwin.inference.observation.healthy_model import HealthyModel

LEAST_LOAD_NM = 1e-6
"""A motor that never carries more torque than this does not sag [N m]."""
LEAST_SCATTER_RAD = 1e-5
"""Wear is counted by scatters of this size at least [rad]."""


@dataclass(frozen=True)
class WearLimits:
    """How fast and how far a healthy motor may change, in scatters of the motor.

    The same figures hold for its bias, its friction and its sag at the largest load. No long
    records of a real arm exist, so they are assumed: on the ArmPi FPV, where a scatter is 1 to 1.7
    counts, swings of a count in some hundred runs are followed, as of temperature, and wear of some
    counts in all.

    Attributes:
        rate: Random walk from run to run, its standard deviation [per root run].
        reach: How far the latest runs may lie off what is behind, beyond chance: more is a fault
            that grows, not wear.
        limit: How far the robot may go from where it began; beyond that, calibrate again.
        horizon: The latest runs are compared with what was believed so many runs ago [run].
    """

    rate: float = 0.025
    reach: float = 0.5
    limit: float = 4.0
    horizon: int = 200


def wear_unit(model: HealthyModel) -> FloatArray:
    """Return what moves a motor by its scatter, at its largest load, (3 motor,).

    It is 0 for the compliance of a motor that gravity does not load.
    """
    load = largest_load(model.twin.robot, model.settling.payload)
    scatter = np.maximum(model.settling.scatter, LEAST_SCATTER_RAD)
    sag = np.divide(scatter, load, out=np.zeros_like(load), where=load > LEAST_LOAD_NM)
    return np.concatenate([scatter, sag, scatter])
