"""Which simple mistake of a set-up explains settled poses that fit no hypothesis.

A mistake is undone on commands or tool positions and the healthy prediction asked again: the first
of the list that brings the tool near is told. Simple ones come first, since a frame turned anyhow
can explain few poses by chance.

Section: docs/inference.md#set-ups
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.set_ups.set_ups import SetUp, extent, simple_set_ups

NOWHERE = "the tool is nowhere near where it should be"
"""What is said of a run that fits no hypothesis."""
NOTHING_SIMPLE = (
    "in this run alone no unit, axis, frame, sense or exchange of columns explains it; a spoilt "
    "sensor, another robot, or a fault beside a wrong set-up may"
)
"""What is said where no simple mistake explains it."""
ALONE = "alone explains it"
"""Said of a motor that does."""
MISFITS, MAY_MISFIT = "the log does not fit the profile", "the log may not fit the profile"
"""What is said of a set-up that is wrong, or may be."""
UNDONE = "; judged with that undone"
"""Said behind that of a set-up that is wrong for sure."""
ANOTHER = "no fault explains it, and the set-up is not wrong in one way that is known"
"""What is said of a set-up that nothing explains."""
ELSEWHERE = "the sensor does not seem to stand where the profile says"
"""What is said of a sensor that was moved."""
DOUBTS = (MISFITS, MAY_MISFIT, ANOTHER, ELSEWHERE, NOWHERE)
"""Remarks by which a set-up is uncertain."""


def undone(remarks: Iterable[str]) -> str:
    """Return what is wrong with the set-up of a log that is judged with that undone; empty: none.

    Args:
        remarks: On the log, such as ``the log does not fit the profile (99.3 % sure): ...``.
    """
    said = next((line for line in remarks if UNDONE in line), "")
    return said.partition("): ")[2].partition(": ")[0]


NEAR = 0.12
"""Median distance, in that of the poses from their middle, within which a set-up explains a log:
sag and scatter of a printed arm take up half of it."""
GAIN = 0.25
"""It must also be this much nearer than the set-up as it is, in the distance of that [-]."""


def wrong_setup(twin: DigitalTwin, target: FloatArray, point: FloatArray) -> SetUp | None:
    """Return the simplest mistake that explains settled poses; None if none does.

    Args:
        twin: Kinematics as the profile has them.
        target: Commanded angles, (pose, motor) [rad].
        point: Settled tool positions, (pose, 3) [m].
    """
    if len(target) < 2:
        return None
    expected = twin.path(target)

    def away(command: FloatArray, seen: FloatArray) -> float:
        return float(np.median(np.linalg.norm(seen - twin.path(command), axis=1)))

    enough = min(NEAR * extent(expected), GAIN * away(target, point))
    for setup in simple_set_ups(twin.robot, expected, point):
        undo = setup.correction
        if away(undo.command(target), undo.point(point)) < enough:
            return setup
    return None
