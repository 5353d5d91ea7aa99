"""Results of `act` and of `reach` as tables and a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from failuretwin.app.reports.plots import clean, new_figure, save_figure
from failuretwin.app.terminal import Table
from failuretwin.decision.acting.reach import MotorReach, Reach
from failuretwin.decision.acting.task import TargetResult

NEVER = 0.85
"""Share of an error that a correction leaves, above which feedback alone does not converge in
time."""


def result_parts(results: Sequence[TargetResult]) -> list[str | Table]:
    """Return a row for each target, and a line for all."""
    rows = []
    for number, result in enumerate(results, start=1):
        error = "not seen" if math.isnan(result.error_m) else f"{1e3 * result.error_m:.1f} mm"
        if result.direction_error_rad is not None:
            error += f" {math.degrees(result.direction_error_rad):.1f} deg"
        state = "reached" if result.reached else result.why
        rows.append([str(number), error, f"{result.movements} movements", state])
    reached = sum(result.reached for result in results)
    moves = sum(result.movements for result in results)
    return [
        Table(("target", "error", "movements", "state"), rows, "rrrl", header=False),
        f"{reached} of {len(results)} targets reached in {moves} movements",
    ]


def by_motor_parts(motors: Sequence[MotorReach]) -> list[str | Table]:
    """Return a row for each motor: the reachable share with it held, and its best angle."""
    rows = []
    for motor in motors:
        left = f"leaves {motor.feedback_factor:.0%} of an error each time"
        alone = "never gets there" if motor.feedback_factor > NEVER else left
        shares = (motor.share.mean(), motor.share.min(), motor.share.max())
        angle = f"{np.rad2deg(motor.best_angle):.0f}"
        rows.append([motor.motor, *(f"{share:.0%}" for share in shares), angle, alone])
    headings = ("held", "reached", "worst", "best", "at deg", "feedback alone")
    return [Table(headings, rows, "lrrrrl")]


def map_parts(found: Reach, *, per_point: bool) -> list[str | Table]:
    """Return the reachable points; `per_point`: with a row for each."""
    rows = []
    points = zip(found.points, found.miss_m, found.reached, strict=True)
    for number, (point, miss, reached) in enumerate(points, start=1):
        state = "can be reached" if reached else f"misses by {1e3 * miss:.0f} mm"
        if np.isinf(miss):
            state = "no pose off the floor and the links points as required"
        rows.append([str(number), *(f"{x:.3f}" for x in point), state])
    where = f"{found.motor} held at {np.rad2deg(found.angle):.0f} deg"
    said = f"{found.reached.sum()} of {len(found.points)} points can be reached with {where}"
    table = Table(("point", "x", "y", "z", "state"), rows, "rrrrl", header=False)
    return [table, said] if per_point else [said]


def save_map(maps: Sequence[Reach], folder: Path) -> None:
    """Draw each map from above and from the side; reachable points are filled, others hollow."""
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
