"""A sketch of an arm as SVG, made from the forward kinematics of its chain.

    T_k = T_k-1 T_pj,k A_k(q_k),    p_k = origin of T_k,    tool p = origin of T_n T_jt

seen from the side: z of the base upwards, and across the horizontal direction in which the origins
spread most. Joints are dots; a marked one is larger, ringed and named.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

import numpy as np

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
    pose, places = np.eye(4), [np.zeros(3)]
    for joint, value in zip(chain.joints, q, strict=True):
        pose = pose @ joint.T_pj
        own = np.eye(4)
        if joint.prismatic:
            own[2, 3] = value
        else:
            c, s = np.cos(value), np.sin(value)
            own[:2, :2] = [[c, -s], [s, c]]
        pose = pose @ own
        places.append(pose[:3, 3])
    return np.array([*places, (pose @ chain.T_jt)[:3, 3]])


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
    named = ", ".join(f"{mark.label} marked" for mark in marks.values()) or "no joint marked"
    way = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    (x, y), (tool_x, tool_y) = points[0], points[-1]
    parts = [
        f'<svg class="arm" viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}" role="img" '
        f'aria-label="Sketch of the arm from the side: {escape(named)}">',
        f'<path d="M{x - 22:.1f},{y + 8:.1f}h44M{x:.1f},{y:.1f}v8" class="base"/>',
        f'<polyline points="{way}" class="links"/>',
        f'<path d="M{tool_x - 6:.1f},{tool_y:.1f}h12M{tool_x:.1f},{tool_y - 6:.1f}v12" '
        'class="tool"/>',
        *_dots(robot, points[1:-1], marks),
        "</svg>",
    ]
    return "".join(parts)


def _dots(robot: Robot, points: FloatArray, marks: Mapping[str, Mark]) -> list[str]:
    """Return the joints, those that are marked last, so that they lie on top."""
    plain, marked = [], []
    is_marked = np.array([motor.name in marks for motor in robot.motors])
    for k, (motor, (x, y)) in enumerate(zip(robot.motors, points, strict=True)):
        near = np.flatnonzero(np.linalg.norm(points - points[k], axis=1) < APART_PX)
        mark, row = marks.get(motor.name), int(np.flatnonzero(near == k)[0])
        if mark is None:
            plain.append(f'<circle class="joint" cx="{x:.1f}" cy="{y:.1f}" r="5"/>')
            others = [str(i + 1) for i in near.tolist() if robot.motors[i].name not in marks]
            if others[0] == str(k + 1):
                told = ", ".join(others)
                plain.append(f'<text x="{x - 10:.1f}" y="{y + 4:.1f}" class="number">{told}</text>')
            continue
        at = float(np.clip(x, LABEL_ROOM, WIDTH - LABEL_ROOM))
        over = (y - points[:, 1] > 0.0) & (y - points[:, 1] < LABEL_ROOM) & is_marked
        if over.any() and not row:  # another mark is in the way: beside it, towards the middle
            at = x + (LABEL_ROOM if x < 0.5 * WIDTH else -LABEL_ROOM)
        up = y + 5.0 if over.any() and not row else y - 21.0 - 16.0 * row
        marked.append(
            f'<g class="marked" fill="{mark.colour}"><circle cx="{x:.1f}" cy="{y:.1f}" r="13" '
            f'fill="white" stroke="{mark.colour}" stroke-width="4"/>'
            f'<text x="{x:.1f}" y="{y + 5:.1f}" text-anchor="middle">{mark.sign}</text>'
            f'<text x="{at:.1f}" y="{up:.1f}" text-anchor="middle" '
            f'class="label">{escape(mark.label)}</text></g>'
        )
    return plain + marked
