"""Results of `act` as lines; what an arm can still reach as a table and a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from failuretwin.app.reports.plots import clean, new_figure, save_figure
from failuretwin.decision.acting.reach import MotorReach, Reach
from failuretwin.decision.acting.task import TargetResult

NEVER = 0.85
"""Share of an error that a correction leaves, above which feedback alone does not converge in
time."""


def table_lines(results: Sequence[TargetResult]) -> list[str]:
    """Return a line for each target, and one for all."""
    lines = []
    for number, result in enumerate(results, start=1):
        error = "not seen" if math.isnan(result.error_m) else f"{1e3 * result.error_m:5.1f} mm"
        if result.direction_error_rad is not None:
            error += f" {math.degrees(result.direction_error_rad):4.1f} deg"
        state = "reached" if result.reached else result.why
        lines.append(f"{number:4d}  {error:>9s}  {result.movements:2d} movements  {state}")
    reached = sum(result.reached for result in results)
    moves = sum(result.movements for result in results)
    lines.append(f"{reached} of {len(results)} targets reached in {moves} movements")
    return lines


def by_motor_lines(motors: Sequence[MotorReach]) -> list[str]:
    """Return a line for each motor: what can be reached with it held, and where to park it."""
    lines = [
        f"{'held':10s} {'reached':>8s} {'worst':>6s} {'best':>6s} {'at deg':>7s}  feedback alone"
    ]
    for motor in motors:
        alone = "never gets there" if motor.feedback_factor > NEVER else (
            f"leaves {motor.feedback_factor:.0%} of an error each time"
        )  # fmt: skip
        lines.append(
            f"{motor.motor:10s} {motor.share.mean():8.0%} {motor.share.min():6.0%} "
            f"{motor.share.max():6.0%} {np.rad2deg(motor.best_angle):7.0f}  {alone}"
        )
    return lines


def map_lines(found: Reach, *, per_point: bool) -> list[str]:
    """Return what can be reached, point by point where that is asked for."""
    lines = []
    if per_point:
        for i, (point, miss) in enumerate(zip(found.points, found.miss_m, strict=True), start=1):
            state = "can be reached" if found.reached[i - 1] else f"misses by {1e3 * miss:.0f} mm"
            if np.isinf(miss):
                state = "no pose off the floor and the links points as it shall"
            lines.append(f"{i:4d}  {point[0]:8.3f} {point[1]:8.3f} {point[2]:8.3f}  {state}")
    count = int(found.reached.sum())
    where = f"{found.motor} held at {np.rad2deg(found.angle):.0f} deg"
    lines.append(f"{count} of {len(found.points)} points can be reached with {where}")
    return lines


def save_map(maps: Sequence[Reach], folder: Path) -> None:
    """Draw each map from above and from the side: filled what can be reached, hollow what cannot.

    Raises:
        InputError: If matplotlib is missing.
        OutputError: If it cannot be written.
    """
    figure = new_figure(7.0, 3.0 * len(maps))
    panels = np.atleast_2d(figure.subplots(len(maps), 2))
    for (above, side), found in zip(panels, maps, strict=True):
        distance = np.linalg.norm(found.points[:, :2], axis=1)
        views = (
            (above, found.points[:, 0], found.points[:, 1], "x [m]", "y [m]"),
            (side, distance, found.points[:, 2], "distance from the axis [m]", "z [m]"),
        )
        for panel, across, up, name_across, name_up in views:
            clean(panel)
            hit = found.reached
            panel.scatter(across[~hit], up[~hit], s=9, facecolors="none", edgecolors="#b0482f")
            panel.scatter(across[hit], up[hit], s=9, color="#2f6db0")
            panel.set_xlabel(name_across)
            panel.set_ylabel(name_up)
            panel.set_aspect("equal", adjustable="datalim")
        above.set_title(f"{found.motor} at {np.rad2deg(found.angle):.0f} deg: {found.share:.0%}")
    save_figure(figure, folder, "reach.png")
