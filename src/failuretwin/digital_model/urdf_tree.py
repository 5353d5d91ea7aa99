"""How the links of a URDF hang together: roots, leaves and the way to the tool."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.digital_model.urdf import MOVING_TYPES, Urdf, UrdfJoint


@dataclass(frozen=True)
class Leaf:
    """A link at the end of a branch, which may be the tool.

    Attributes:
        link: Its name.
        moving: Joints between base and link that a motor can move.
        length: Length of the way along the joint frames [m].
    """

    link: str
    moving: int
    length: float


def is_motor_joint(joint: UrdfJoint) -> bool:
    """Return whether a motor of its own can move `joint`."""
    return joint.type in MOVING_TYPES and joint.mimic is None


def roots(urdf: Urdf) -> list[str]:
    """Return the links that hang from no other."""
    children = {joint.child for joint in urdf.joints}
    return [link for link in dict.fromkeys(urdf.links) if link not in children]


def twice_carried(urdf: Urdf) -> list[str]:
    """Return the links that are the child of several joints, which closes a loop."""
    counts = Counter(joint.child for joint in urdf.joints)
    return [link for link, count in counts.items() if count > 1]


def leaves(urdf: Urdf, base: str) -> list[Leaf]:
    """Return the ends of all branches above `base`, the best candidate for the tool first.

    That is the one with the most motors on the way to it and, among equals, the longest way.
    """
    by_parent: dict[str, list[UrdfJoint]] = {}
    for joint in urdf.joints:
        by_parent.setdefault(joint.parent, []).append(joint)
    found, open_ways, seen = [], [(Leaf(base, 0, 0.0))], set()
    while open_ways:
        leaf = open_ways.pop()
        if leaf.link in seen:
            continue
        seen.add(leaf.link)
        joints = by_parent.get(leaf.link, [])
        open_ways += [_step(leaf, joint) for joint in joints]
        if not joints and leaf.link in urdf.links:
            found.append(leaf)
    return sorted(found, key=lambda leaf: (-leaf.moving, -round(leaf.length, 9), leaf.link))


def _step(leaf: Leaf, joint: UrdfJoint) -> Leaf:
    length = float(np.linalg.norm(joint.T_pc[:3, 3]))
    return Leaf(joint.child, leaf.moving + is_motor_joint(joint), leaf.length + length)


def rigid_body(urdf: Urdf, link: str) -> list[str]:
    """Return `link` and all links that fixed joints hold to it further out."""
    body = [link]
    for name in body:
        fixed = (j for j in urdf.joints if j.parent == name and j.type == "fixed")
        body += [joint.child for joint in fixed if joint.child not in body]
    return body


def links_beyond(urdf: Urdf, joints: Sequence[UrdfJoint]) -> list[str]:
    """Return all links that the first motor of `joints` carries."""
    first = next((joint for joint in joints if is_motor_joint(joint)), None)
    carried = [] if first is None else [first.child]
    for name in carried:
        carried += [j.child for j in urdf.joints if j.parent == name and j.child not in carried]
    return carried
