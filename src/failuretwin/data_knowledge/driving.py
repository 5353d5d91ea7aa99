"""From commands to what the motors are really told, once faults and bad luck have had their say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.disturbances import Disturbances
from failuretwin.digital_model.engine import Drive
from failuretwin.digital_model.imperfect import actual_movements, lagged
from failuretwin.failure_behavior.injection import Injection


def drive_of(
    commanded: Movements,
    command: FloatArray,
    time: FloatArray,
    injection: Injection,
    chance: Disturbances,
) -> Drive:
    """Return what the motors of some runs are told.

    Args:
        commanded: Movements as commanded.
        command: Their references, (run, time, motor) [rad].
        time: Uniform grid, (time,) [s].
        injection: Faults of the runs.
        chance: Bad luck of the runs.
    """
    faulty, lost = injection.on_movements(commanded, chance.lost)
    actual = actual_movements(faulty, replace(chance, lost=lost))
    followed = command if _same(actual, commanded) else actual.reference(time)
    followed = lagged(followed, time, chance.lag)
    return Drive(
        reference=injection.on_reference(followed, time),
        held=injection.held(time),
        weakness=injection.weakness(time),
        compliance=chance.compliance if chance.compliance.any() else None,
        payload=chance.payload if chance.payload.any() else None,
    )


def _same(one: Movements, other: Movements) -> bool:
    names = ("initial", "target", "ramp_duration", "start")
    return all(np.array_equal(getattr(one, n), getattr(other, n), equal_nan=True) for n in names)
