"""What it costs to spare worn motors, and how worn they are by what `diagnose --track` keeps.

    weight_k = max over bias, sag, friction of max(0, |now - first| - 1.645 deviation) / limit

Changes are counted from the first run of the history, in scatters of the motor; what its doubts
can explain is no wear.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.connection.life_history import read_rows
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.planner import Planner, Standing, turned_round
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.together.wear_limits import WearLimits, wear_unit

HALF_90 = 1.645
"""Half of a 90 % interval in standard deviations."""
TRACKED = ("bias", "compliance", "friction")
"""What a history follows of each motor, in the order of `wear_unit`."""


def wear_weights(history: Path, model: HealthyModel) -> FloatArray:
    """Return how worn each motor is, in shares of what is allowed, (motor,) [-], 1 at most.

    Args:
        history: CAL.history.jsonl.
        model: The robot.

    Raises:
        InputError: If the history cannot be read, is of another robot, or holds no run.
    """
    rows = read_rows(history, model.twin.robot.name)
    if not rows:
        raise InputError(f"{history}: holds no run. Expected what `diagnose --track` keeps.")
    change, doubt = (_change(rows, suffix) for suffix in ("", "_deviation"))
    unit = wear_unit(model).reshape(len(TRACKED), -1)
    beyond = np.maximum(np.abs(change) - HALF_90 * doubt, 0.0)
    worn = np.divide(beyond, unit, out=np.zeros_like(beyond), where=unit > 0.0)
    return np.asarray(np.minimum(worn.max(axis=0) / WearLimits().limit, 1.0))


def stopped_learning(history: Path, robot: str) -> str:
    """Return why a history learns no more: what changed as no wear does; empty if it learns.

    Args:
        history: CAL.history.jsonl.
        robot: Name of the robot that it must be of.

    Raises:
        InputError: If it cannot be read or is of another robot.
    """
    rows = read_rows(history, robot)
    return str(rows[-1].get("alarm", "")) if rows else ""


def _change(rows: Sequence[Mapping[str, Any]], suffix: str) -> FloatArray:
    """Return last less first of what is tracked, or both deviations together, (3, motor)."""
    first, last = (
        np.array([row[f"{name}{suffix}"] for name in TRACKED], dtype=np.float64)
        for row in (rows[0], rows[-1])
    )
    return np.asarray(np.hypot(first, last) if suffix else last - first)


# What it costs.


@dataclass(frozen=True)
class Effort:
    """What one way asks of the arm.

    Attributes:
        way_s: Its time [s].
        load: Load of each motor at its end, in shares of its largest, (motor,) [-].
        travel: How far each goes, (motor,) [rad].
        reversals: Which motors it turns round, (motor,) [-].
    """

    way_s: float
    load: FloatArray
    travel: FloatArray
    reversals: FloatArray

    @classmethod
    def of(cls, planner: Planner, pose: FloatArray, at: Standing) -> Effort:
        """Return that of the way to a pose (motor,) [rad]."""
        return cls(
            float(planner.way_s(pose, at)),
            planner.load(pose),
            np.abs(pose - at.pose),
            turned_round(pose, at).astype(np.float64),
        )


def sparing_lines(
    names: Sequence[str], spared: FloatArray, ways: Sequence[tuple[Effort, ...]]
) -> list[str]:
    """Return in words what sparing has changed.

    Args:
        names: Names of the motors.
        spared: Weight of each, (motor,).
        ways: Each way as it was taken, and as it would have been.
    """
    if not ways:
        return []

    def both(name: str, motor: int | None = None) -> list[float]:
        values = np.array([[getattr(effort, name) for effort in way] for way in ways])
        return np.asarray((values if motor is None else values[..., motor]).mean(axis=0)).tolist()

    taken, plain = both("way_s")
    lines = []
    for k in np.flatnonzero(spared).tolist():
        load, travel, reversals = (both(name, k) for name in ("load", "travel", "reversals"))
        lines.append(
            f"{names[k]} spared (weight {spared[k]:.2f}): load {load[0]:.0%} instead of "
            f"{load[1]:.0%} of its largest, {travel[0]:.2f} instead of {travel[1]:.2f} rad a "
            f"target, turned round in {reversals[0]:.0%} instead of {reversals[1]:.0%}"
        )
    return [
        *lines,
        f"which costs {taken - plain:+.2f} s a target ({taken:.2f} instead of {plain:.2f})",
    ]
