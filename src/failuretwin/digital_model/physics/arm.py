"""The URDF as a rigid arm in MuJoCo: only joints with motors move, nothing collides."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np

from failuretwin.core.errors import InputError, needs_extra
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.geometry import roll_pitch_yaw
from failuretwin.digital_model.kinematics import GRAVITY
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.urdf.file import Urdf, read_root, read_urdf

TOOL = "tool point"
"""Name of the site at the tool point."""

JOINT_PARTS = ("parent", "child", "origin", "axis")
"""Copied parts of a joint; limits, friction and mimicry are dropped."""
NEXT_TO_NOTHING = 1e-9
"""Mass [kg] and moment of inertia [kg m2] of links without stated ones."""


def load_mujoco() -> Any:
    """Return the module `mujoco`."""
    with needs_extra("the physics engine needs mujoco", "physics"):
        import mujoco
        import mujoco.rollout
    return mujoco


def arm_spec(robot: Robot, payload: float = 0.0) -> Any:
    """Return the robot as a `mujoco.MjSpec` that can still be changed.

    Joints turn in the physical sense and keep their URDF names; joints without a motor stay at
    zero. Gravity points down the z axis of the base frame. The payload is a point mass at the tool
    point [kg].
    """
    mujoco = load_mujoco()
    path = robot.urdf_file
    root = read_root(path)
    _strip(root, {motor.joint for motor in robot.motors})
    _correct(root, robot)
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise InputError(f"{path}: MuJoCo cannot use it ({error}).") from error
    spec.compiler.fusestatic = True
    spec.compiler.balanceinertia = True
    spec.compiler.boundmass = spec.compiler.boundinertia = NEXT_TO_NOTHING
    spec.option.gravity = -GRAVITY * _up(read_urdf(path), robot.profile.base_link)
    spec.option.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    tool, at = spec.body(robot.profile.tool_link), robot.profile.tool_xyz
    tool.add_site(name=TOOL, pos=at)
    if payload > 0.0:
        point = tool.add_body(name="payload", pos=at, mass=payload, explicitinertial=True)
        point.inertia = np.full(3, NEXT_TO_NOTHING)
    return spec


def _strip(root: ElementTree.Element, moving: set[str]) -> None:
    """Reduce the tree to links with masses and joints, of which only `moving` move."""
    for element in list(root):
        keep = {"link": ("inertial",), "joint": JOINT_PARTS}.get(element.tag)
        if keep is None:
            root.remove(element)
            continue
        if element.tag == "joint" and element.get("name") not in moving:
            element.set("type", "fixed")
        for part in list(element):
            useless = part.tag == "axis" and element.get("type") == "fixed"
            if part.tag not in keep or useless:
                element.remove(part)


def _correct(root: ElementTree.Element, robot: Robot) -> None:
    """Apply the joint corrections of the profile."""
    corrected = {c.joint for c in robot.profile.geometry.joints}
    urdf = robot.profile.geometry.apply(read_urdf(robot.urdf_file))
    poses = {joint.name: joint.T_pc for joint in urdf.joints if joint.name in corrected}
    for element in root.findall("joint"):
        T = poses.get(element.get("name", ""))
        if T is None:
            continue
        for old in element.findall("origin"):
            element.remove(old)
        xyz, rpy = T[:3, 3].tolist(), roll_pitch_yaw(T[:3, :3])
        texts = (" ".join(f"{value:.17g}" for value in triple) for triple in (xyz, rpy))
        element.append(ElementTree.Element("origin", dict(zip(("xyz", "rpy"), texts, strict=True))))


def _up(urdf: Urdf, base_link: str) -> FloatArray:
    """Return the z axis of the base frame in the frame of the URDF's root, (3,)."""
    by_child = {joint.child: joint for joint in urdf.joints}
    up, link = np.array([0.0, 0.0, 1.0]), base_link
    while link in by_child:
        up = by_child[link].T_pc[:3, :3] @ up
        link = by_child[link].parent
    return up
