"""A sketch of an arm as SVG, made from the forward kinematics of its chain.

    T_k = T_k-1 T_pj,k A_k(q_k),    p_k = origin of T_k,    tool p = origin of T_n T_jt

seen from the side: z of the base upwards, and across the horizontal direction in which the origins
spread most. Joints are dots; a marked one is larger, ringed and named.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from failuretwin.app.reports.plots import render_page
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.kinematics import SerialChain
from failuretwin.digital_model.robot import Robot

WIDTH, HEIGHT, MARGIN = 320.0, 260.0, 44.0
"""Size of the picture, and what is left free around the arm [px]."""
APART_PX = 12.0
"""Joints that are nearer to each other than this share a label."""
LABEL_ROOM = 60.0
"""Labels are centred no nearer to an edge than this [px]."""
BENT = 0.35
"""Share of the range from its middle by which joints are bent, so that no arm is one line."""


@dataclass(frozen=True)
class Mark:
    """How a joint is marked.

    Attributes:
        colour: Of its ring and label.
        sign: Letter in it.
        label: What stands beside it.
    """

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


def on_picture(seen: FloatArray) -> FloatArray:
    """Return places on the picture, all in one scale, y downwards, (place, 2) [px]."""
    low, extent = seen.min(axis=0), np.maximum(np.ptp(seen, axis=0), 1e-9)
    room = np.array([WIDTH, HEIGHT]) - 2.0 * MARGIN
    scale = float((room / extent).min())
    free = 0.5 * (room - scale * extent)
    right, up = (MARGIN + free + scale * (seen - low)).T
    return np.column_stack([right, HEIGHT - up])


def arm_sketch(robot: Robot, marks: Mapping[str, Mark]) -> str:
    """Return the sketch as an SVG element.

    Args:
        robot: The robot.
        marks: How motors are marked, by their names; the others are dots with their number.
    """
    places = joint_places(robot.loads.chain, resting_pose(robot))
    points = on_picture(seen_from_the_side(places))
    values = {
        "width": WIDTH,
        "height": HEIGHT,
        "points": points.tolist(),
        "marks": list(marks.values()),
        "plain": _plain_dots(robot, points[1:-1], marks),
        "marked": _marked_dots(robot, points[1:-1], marks),
    }
    return render_page("arm.svg.j2", values)


def _neighbours(points: FloatArray, k: int) -> list[int]:
    """Return the joints that are drawn at about the same place as joint k, itself included."""
    return np.flatnonzero(np.linalg.norm(points - points[k], axis=1) < APART_PX).tolist()


def _plain_dots(
    robot: Robot, points: FloatArray, marks: Mapping[str, Mark]
) -> list[tuple[float, float, str]]:
    """Return place and numbers of each joint without a mark; joints at one place share a label."""
    names, dots = robot.motor_names, []
    for k in [k for k, name in enumerate(names) if name not in marks]:
        together = [i for i in _neighbours(points, k) if names[i] not in marks]
        numbers = ", ".join(str(i + 1) for i in together) if together[0] == k else ""
        dots.append((*points[k].tolist(), numbers))
    return dots


def _marked_dots(
    robot: Robot, points: FloatArray, marks: Mapping[str, Mark]
) -> list[tuple[float, float, float, float, Mark]]:
    """Return place, place of the label, and mark of each marked joint."""
    is_marked = np.array([name in marks for name in robot.motor_names])
    dots = []
    for k in np.flatnonzero(is_marked).tolist():
        (x, y), row = points[k].tolist(), _neighbours(points, k).index(k)
        at, up = float(np.clip(x, LABEL_ROOM, WIDTH - LABEL_ROOM)), y - 21.0 - 16.0 * row
        over = (y - points[:, 1] > 0.0) & (y - points[:, 1] < LABEL_ROOM) & is_marked
        if over.any() and not row:  # another mark is in the way: beside it, towards the middle
            at, up = x + (LABEL_ROOM if x < 0.5 * WIDTH else -LABEL_ROOM), y + 5.0
        dots.append((x, y, at, up, marks[robot.motor_names[k]]))
    return dots
