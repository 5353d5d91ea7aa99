"""A sketch of an arm, made from the forward kinematics of its chain.

    T_k = T_k-1 T_pj,k A_k(q_k),    p_k = origin of T_k,    tool p = origin of T_n T_jt

seen from the side: z of the base upwards, and across the horizontal direction in which the origins
spread most. Joints are dots with their number; a marked one is larger, ringed and named.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.app.reports.plots import new_figure
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.kinematics import SerialChain
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

APART = 0.05
"""Distance below which joints share a label, as a share of the arm's extent."""
BENT = 0.35
"""Share of the range from its middle by which joints are bent, so that no arm is one line."""
LINKS, JOINTS = "#566069", "#1d2429"
"""Colours of links and of joints without a mark."""


@dataclass(frozen=True)
class Mark:
    """Mark of a joint: colour of ring and label, letter in the ring, label above it."""

    colour: str
    sign: str
    label: str


def joint_places(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Return base, origin of every joint frame and the tool, (joint + 2, 3) [m], base frame.

    Args:
        chain: The kinematics, in the frame of the base.
        q: Joint values in chain order, (joint,) [rad or m].
    """
    return np.vstack([np.zeros(3), chain.frames(q)[1]])


def resting_pose(robot: Robot) -> FloatArray:
    """Return the pose that is drawn, physical joint values, (motor,) [rad or m].

    Home where the profile names one; else a little off the middle of the usual movements.
    """
    values = []
    for motor in robot.motors:
        low, high = motor.movement_range
        bent = 0.5 * (low + high) + BENT * 0.5 * (high - low)
        values.append(bent if motor.home is None else motor.home)
    return np.array(values) * robot.sense


def seen_from_the_side(places: FloatArray) -> FloatArray:
    """Return places as they are seen, across and up, (place, 2) [m]."""
    flat = places[:, :2] - places[:, :2].mean(axis=0)
    _, _, direction = np.linalg.svd(flat, full_matrices=True)
    across = flat @ direction[0]
    if across[-1] < across[0]:
        across = -across
    return np.column_stack([across, places[:, 2]])


def arm_sketch(robot: Robot, marks: Mapping[str, Mark]) -> Figure:
    """Return the sketch; motors without a mark, by their names, are dots with their number."""
    points = seen_from_the_side(joint_places(robot.loads.chain, resting_pose(robot)))
    figure = new_figure(4.0, 3.3)
    panel = figure.add_subplot(aspect="equal", adjustable="datalim")
    panel.axis("off")
    panel.margins(0.22, 0.12)
    panel.plot(*points.T, color=LINKS, lw=5.0, solid_joinstyle="round", zorder=1)
    panel.plot(*points[0], "_", ms=36.0, mew=2.5, color=JOINTS, clip_on=False)
    panel.plot(*points[-1], "+", ms=12.0, mew=2.5, color=JOINTS)
    numbers, rows = defaultdict[int, list[str]](list), Counter[int]()
    for k, (name, place) in enumerate(zip(robot.motor_names, points[1:-1], strict=True)):
        first, mark = _first_at(points[1:-1], k), marks.get(name)
        if mark is None:
            panel.plot(*place, "o", ms=8.0, color=JOINTS)
            numbers[first].append(str(k + 1))
            continue
        panel.plot(*place, "o", ms=20.0, mew=3.5, mfc="white", color=mark.colour, clip_on=False)
        _write(panel, mark.sign, place, (0, -4), "center", mark.colour)
        _write(panel, mark.label, place, (0, 15 + 14 * rows[first]), "center", mark.colour)
        rows[first] += 1
    for k, together in numbers.items():
        _write(panel, ", ".join(together), points[k + 1], (-9, 2), "right", LINKS)
    return figure


def _first_at(points: FloatArray, k: int) -> int:
    """Return the first joint that is drawn at about the same place as joint k."""
    near = np.linalg.norm(points - points[k], axis=1) < APART * np.ptp(points, axis=0).max()
    return int(np.argmax(near))


def _write(
    panel: Axes, text: str, at: FloatArray, offset: tuple[int, int], side: str, colour: str
) -> None:
    """Write a text with a white edge, `offset` points beside a place."""
    from matplotlib.patheffects import withStroke

    edge = [withStroke(linewidth=3.0, foreground="white")]
    style: dict[str, Any] = {"ha": side, "color": colour, "weight": "bold", "path_effects": edge}
    panel.annotate(text, (at[0], at[1]), offset, textcoords="offset points", fontsize=11, **style)
