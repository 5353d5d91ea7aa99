"""What the links of a URDF carry beside the joints: masses and meshes.

Kinematics needs none of it, so nothing that is missing or odd here is an error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree import ElementTree

MOMENTS = ("ixx", "iyy", "izz")


@dataclass(frozen=True)
class LinkFacts:
    """What a file says of one link.

    Attributes:
        name: Name of the link.
        mass: Its mass [kg]; None where the file states none that can be read.
        centre: Centre of the mass in the link's frame [m]; the frame's origin where none is stated.
        has_inertia: Whether all three moments of inertia are stated and above zero.
        meshes: Mesh files as the file names them.
    """

    name: str
    mass: float | None
    centre: tuple[float, float, float]
    has_inertia: bool
    meshes: tuple[str, ...]


def read_links(root: ElementTree.Element) -> dict[str, LinkFacts]:
    """Return the links below the <robot> element `root` by their names."""
    facts = (_read_link(link) for link in root.findall("link"))
    return {fact.name: fact for fact in facts}


def _read_link(link: ElementTree.Element) -> LinkFacts:
    inertia = link.find("inertial/inertia")
    moments = [_number(inertia, key) for key in MOMENTS]
    return LinkFacts(
        name=link.get("name", ""),
        mass=_number(link.find("inertial/mass"), "value"),
        centre=_centre(link.find("inertial/origin")),
        has_inertia=all(moment is not None and moment > 0.0 for moment in moments),
        meshes=tuple(mesh.get("filename", "") for mesh in link.iter("mesh")),
    )


def _centre(origin: ElementTree.Element | None) -> tuple[float, float, float]:
    text = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
    try:
        x, y, z = (float(part) for part in text.split())
    except ValueError:
        return 0.0, 0.0, 0.0
    return x, y, z


def _number(element: ElementTree.Element | None, key: str) -> float | None:
    try:
        value = float("nan" if element is None else element.get(key, "nan"))
    except ValueError:
        return None
    return value if math.isfinite(value) else None
