"""Rounding in a log: how coarsely commands and tool positions were written down.

No tool comes to rest on a decimal grid by itself, so one that always does was rounded, and each
position is off by q / sqrt(12). Commands may well have been given in whole degrees; that they were
rounded in the log alone is weighed by how the arm scatters about them,

    p(rounded | runs) / p(told so | runs) = p(runs | s^2 + q^2 / 12) / p(runs | s^2)

with s the scatter of each motor, at even odds.

Section: docs/inference.md#set-ups
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.observation.healthy_model import HealthyModel

STEPS = tuple(digit * 10.0**power for power in range(2, -6, -1) for digit in (5.0, 2.0, 1.0))
"""Steps of decimal grids, in the unit that a value was written in."""
EXACT = 1e-3
"""How far from a grid values may lie, as a share of its step: stores keep seven digits."""
LEAST_VALUES = 8
"""So many different values show a grid; fewer may lie on one by chance."""
MATTERS = 0.5
"""Rounding by less than this share of what is known to scatter is not told."""


@dataclass(frozen=True)
class Rounding:
    """A grid on which values of a log lie.

    Attributes:
        step: Its step, in SI units.
        told: The same in words.
    """

    step: float
    told: str

    @property
    def deviation(self) -> float:
        """What it rounds off, a standard deviation in SI units."""
        return float(self.step / np.sqrt(12.0))


def grid_of(value: FloatArray, units: dict[str, float]) -> Rounding | None:
    """Return the coarsest decimal grid on which values lie; None: they lie on none.

    Args:
        value: The values, any shape; NaN where there is none.
        units: Units that they may have been written in, by name, each in SI units.
    """
    some = np.unique(value[np.isfinite(value)])
    if len(some) < LEAST_VALUES:
        return None
    found = [
        Rounding(step * unit, f"{step:g} {name}")
        for name, unit in units.items()
        for step in STEPS
        if _on_grid(some / (step * unit))
    ]
    return max(found, key=lambda one: one.step, default=None)


def _on_grid(value: FloatArray) -> bool:
    off = np.abs(value - np.rint(value))
    return bool((off < EXACT).all()) and len(np.unique(np.rint(value))) >= LEAST_VALUES


def tool_rounding(point: FloatArray, model: HealthyModel) -> Rounding | None:
    """Return how coarsely tool positions (..., axis) [m] were rounded; None: it does not matter."""
    grids = [grid_of(point[..., axis], {"mm": 1e-3}) for axis in range(3)]
    known = [one for one in grids if one is not None]
    if not known:
        return None
    finest = min(known, key=lambda one: one.step)
    in_steps = point[np.isfinite(point).all(axis=-1)] / finest.step
    lies = bool((np.abs(in_steps - np.rint(in_steps)) < EXACT).all())  # the third may move little
    return finest if lies and finest.deviation > MATTERS * model.path_noise else None


def command_rounding(target: FloatArray, model: HealthyModel) -> Rounding | None:
    """Return the grid on which commands (..., motor) [rad] lie; None: none that matters."""
    robot = model.twin.robot
    if robot.slides.any():
        return None
    found = grid_of(target, {"deg": float(np.deg2rad(1.0)), "rad": 1.0})
    if found is None or found.deviation < MATTERS * float(np.median(model.scatter)):
        return None
    return None if _whole_counts(found, robot) else found


def _whole_counts(found: Rounding, robot: Robot) -> bool:
    """Return whether a grid is that of the robot's own servo counts."""
    count = abs(robot.servo_units.rad_per_count) if robot.profile.servo_units else 0.0
    return bool(count > 0.0 and abs(found.step - count) < EXACT * count)


def rounded(model: HealthyModel, tool: Rounding | None, command: Rounding | None) -> HealthyModel:
    """Return a healthy robot as a log shows it that was rounded."""
    if tool is not None:
        noise = float(np.hypot(model.untold_noise_m, tool.deviation))
        model = replace(model, untold_noise_m=noise)
    if command is None:
        return model
    scatter = np.hypot(np.asarray(model.settling.scatter), command.deviation)
    settling = replace(model.settling, scatter=tuple(scatter.tolist()))
    return replace(model, imperfections=replace(model.imperfections, settling=settling))


def told_of(tool: Rounding | None, command: Rounding | None, share: float) -> list[str]:
    """Return what is to be said of rounding, a line each.

    Args:
        tool: Of tool positions.
        command: Of commands.
        share: Probability that the log alone rounded these.
    """
    lines = []
    if tool is not None:
        lines.append(
            f"tool positions are rounded to {tool.told}: each is off by up to "
            f"{500.0 * tool.step:.2g} mm, and that is counted as noise. Log them in full"
        )
    if command is not None:
        lines.append(
            f"commands lie on steps of {command.told}, and the arm scatters as if the log had "
            f"rounded them ({share:.1%}): log them in full, or motors seem to miss their targets"
        )
    return lines
