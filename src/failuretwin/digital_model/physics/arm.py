"""A URDF as a rigid arm in MuJoCo: only the motors' joints move, nothing collides."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.physics.extra import load_mujoco
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.urdf import Urdf, read_root, read_urdf

GRAVITY_M_S2 = 9.81
TOOL = "tool point"
"""Name of the site at the tool point."""

JOINT_PARTS = ("parent", "child", "origin", "axis")
"""What is taken over of a joint; limits, friction and mimicry are not."""
NEXT_TO_NOTHING = 1e-9
"""Mass [kg] and moment of inertia [kg m2] of links for which the URDF states none."""


def arm_spec(robot: Robot, payload: float = 0.0) -> Any:
    """Return the robot as a `mujoco.MjSpec` that can still be changed.

    Joints turn in the physical sense and keep their URDF names; those without a motor are held at
    zero. Gravity points down the z axis of the base frame.

    Args:
        robot: The robot.
        payload: Mass of a point at the tool point [kg].

    Raises:
        InputError: If mujoco is missing or cannot use the URDF.
    """
    mujoco = load_mujoco()
    path = robot.urdf_file
    root = read_root(path)
    _strip(root, {motor.joint for motor in robot.motors})
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise InputError(f"{path}: MuJoCo cannot use it ({error}).") from error
    spec.compiler.fusestatic = True
    spec.compiler.balanceinertia = True
    spec.compiler.boundmass = spec.compiler.boundinertia = NEXT_TO_NOTHING
    spec.option.gravity = -GRAVITY_M_S2 * _up(read_urdf(path), robot.profile.base_link)
    spec.option.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    tool = spec.body(robot.profile.tool_link)
    tool.add_site(name=TOOL)
    if payload > 0.0:
        point = tool.add_body(name="payload", mass=payload, explicitinertial=True)
        point.inertia = np.full(3, NEXT_TO_NOTHING)
    return spec


def _strip(root: ElementTree.Element, moving: set[str]) -> None:
    """Leave links with their masses and joints, of which only `moving` move."""
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


def _up(urdf: Urdf, base_link: str) -> FloatArray:
    """Return the z axis of the base frame in the frame of the URDF's root, (3,)."""
    parent = {joint.child: joint.parent for joint in urdf.joints}
    root = base_link
    while root in parent:
        root = parent[root]
    T_rb = np.eye(4)
    for joint in urdf.path(root, base_link):
        T_rb = T_rb @ joint.T_pc
    return T_rb[:3, 2]
