"""Faults as a run set tells them, made again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from failuretwin.core.hypothesis import Fault
from failuretwin.failure_behavior.course import STEP, Course
from failuretwin.failure_behavior.fault_value import FaultValue, PerMovement
from failuretwin.failure_behavior.modes.motion import CHANCE, LOST
from failuretwin.failure_behavior.modes.offsets import OFFSET

_SURE, _NEVER = -1.0, 2.0
"""Chances below and above any share of commands lost."""


def replayed(detail: Mapping[str, Any]) -> FaultValue:
    """Return a fault that strikes as it did before.

    Args:
        detail: What `FaultValue.detail` says of a fault that has struck.
    """
    magnitude, profile = detail["magnitude"], detail["profile"]
    course = Course(
        profile["shape"],
        detail["onset_s"],
        rise_s=profile.get("rise_s", 0.0),
        episodes=tuple((start, end) for start, end in profile.get("episodes_s", ())),
    )
    drawn: dict[str, PerMovement] = {}
    if LOST in detail:
        drawn[CHANCE] = np.where(detail[LOST], _SURE, _NEVER)
    if OFFSET in detail:  # as severe as they were: not to be made severe twice
        drawn[OFFSET] = np.asarray(detail[OFFSET], dtype=np.float64)
        course = Course(STEP, 0.0)
    return FaultValue(
        fault=Fault(detail["motor"], detail["mode"]),
        magnitude=np.nan if magnitude is None else float(magnitude),
        course=course,
        per_movement=drawn,
    )
