"""Arms by their Denavit-Hartenberg figures, apart from the package: URDF, kinematics, poses."""

from __future__ import annotations

import numpy as np

from failuretwin import load_robot
from failuretwin.digital_model.profile_text import profile_text
from failuretwin.digital_model.urdf.check import check_urdf

H = np.pi / 2
UR5 = (
    [0, -0.425, -0.39225, 0, 0, 0],
    [0.089159, 0, 0, 0.10915, 0.09465, 0.0823],
    [H, 0, 0, H, -H, 0],
)
"""a [m], d [m] and alpha [rad] of a UR5, as its maker publishes them."""
UR10 = (
    [0, -0.612, -0.5723, 0, 0, 0],
    [0.1273, 0, 0, 0.163941, 0.1157, 0.0922],
    [H, 0, 0, H, -H, 0],
)
TOOL = np.array([0.0, 0.0, 0.05])
"""Tool point in the last frame [m], on the axis of the last joint."""


def forward(q, dh=UR5, tool=TOOL):
    """Return tool points (pose, 3) of angles (pose, joint) by the product of the DH matrices."""
    q = np.column_stack([q, np.zeros((len(q), len(dh[0]) - q.shape[1]))])
    frame = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for j, (a, d, alpha) in enumerate(zip(*dh, strict=True)):
        c, s, ca, sa = np.cos(q[:, j]), np.sin(q[:, j]), np.cos(alpha), np.sin(alpha)
        z, o = np.zeros_like(c), np.ones_like(c)
        rows = [
            [c, -s * ca, s * sa, a * c],
            [s, c * ca, -c * sa, a * s],
            [z, sa * o, ca * o, d * o],
            [z, z, z, o],
        ]
        frame = frame @ np.moveaxis(np.array(rows), -1, 0)
    return frame[:, :3, 3] + frame[:, :3, :3] @ tool


def urdf(dh=UR5, tool=TOOL):
    parts, parent, xyz, roll = ['<robot name="arm"><link name="base"/>'], "base", (0, 0, 0), 0.0
    for j, (a, d, alpha) in enumerate(zip(*dh, strict=True), 1):
        parts.append(
            f'<link name="link_{j}"/><joint name="joint_{j}" type="revolute">'
            f'<parent link="{parent}"/><child link="link_{j}"/>'
            f'<origin xyz="{xyz[0]} {xyz[1]} {xyz[2]}" rpy="{roll} 0 0"/><axis xyz="0 0 1"/>'
            '<limit lower="-6.2832" upper="6.2832" effort="150" velocity="2.0"/></joint>'
        )
        parent, xyz, roll = f"link_{j}", (a, 0, d), alpha
    x, y, z = np.array(xyz) + tool
    parts.append(
        f'<link name="tool"/><joint name="mount" type="fixed"><parent link="{parent}"/>'
        f'<child link="tool"/><origin xyz="{x} {y} {z}"/></joint></robot>'
    )
    return "\n".join(parts)


def robot_in(folder, text):
    """Return the robot of a URDF with the profile that `robot init` writes."""
    path, profile = folder / "arm.urdf", folder / "arm.toml"
    path.write_text(text, encoding="utf-8")
    profile.write_text(profile_text(check_urdf(path), profile), encoding="utf-8")
    return load_robot(profile)
