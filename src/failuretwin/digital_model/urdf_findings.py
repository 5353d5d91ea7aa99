"""What may be wrong with a URDF, each matter in one clear sentence or two.

An error keeps the file from being used; a warning tells of something that will be missing or
assumed; a note tells what was decided.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import numpy as np

from failuretwin.core.errors import unknown_name
from failuretwin.core.types import FloatArray, frozen_array
from failuretwin.digital_model.kinematics import SerialChain
from failuretwin.digital_model.urdf import (
    HELD_TYPES,
    MOVING_TYPES,
    Leaf,
    LinkFacts,
    Urdf,
    UrdfJoint,
    is_motor_joint,
    rigid_body,
    roots,
    twice_carried,
)

# Which joints can move the tool point, and how far it gets: by trying poses.

POSES = 256
SEED = 0
"""The poses are the same each time, so that a report can be repeated."""

CANNOT_MOVE = 1e-9
"""A lever arm below this at every pose is rounding, not motion [m/rad or m/m]."""

FREE_RANGE = np.pi
"""Range tried on either side of zero for a joint without limits [rad or m]."""

ASCENT_STEPS = 100


@dataclass(frozen=True)
class Mobility:
    """What the joints of a chain do to its tool point.

    Attributes:
        lever: Largest speed of the tool for unit speed of each joint over all poses tried,
            (joint,) [m/rad or m/m].
        reach: Farthest distance of the tool from the base frame's origin that was found [m].
    """

    lever: FloatArray
    reach: float

    @property
    def moves(self) -> list[bool]:
        """Whether each joint can move the tool point."""
        return [bool(lever >= CANNOT_MOVE) for lever in self.lever]


def mobility(chain: SerialChain) -> Mobility:
    """Return what the joints of `chain` do to its tool point at random poses in their limits."""
    low, high, poses = _poses(chain)
    return Mobility(frozen_array(levers(chain)), _reach(chain, poses, low, high))


def levers(chain: SerialChain) -> FloatArray:
    """Return the largest speed of the tool for unit speed of each joint, (joint,) [m/rad, m/m]."""
    _, jacobian = chain.position_and_jacobian(_poses(chain)[2])
    return np.linalg.norm(jacobian, axis=-2).max(axis=0)


def _poses(chain: SerialChain) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return lowest and highest joint values (joint,) and random poses between (pose, joint)."""
    low, high = np.array([free_range(joint.low, joint.high) for joint in chain.joints]).T
    return low, high, np.random.default_rng(SEED).uniform(low, high, (POSES, len(low)))


def has_range(low: float, high: float) -> bool:
    """Return whether limits are a range; exporters write 0 and 0 for ones they do not know."""
    return bool(np.isfinite(low) and np.isfinite(high) and low < high)


def free_range(low: float, high: float) -> tuple[float, float]:
    """Return the limits where they are a range, a range about zero where they are not."""
    return (low, high) if has_range(low, high) else (-FREE_RANGE, FREE_RANGE)


def _reach(chain: SerialChain, poses: FloatArray, low: FloatArray, high: FloatArray) -> float:
    """Climb from all poses at once in the direction that takes the tool away from the base."""
    point, jacobian = chain.position_and_jacobian(poses)
    scale = float(np.linalg.norm(point, axis=-1).max()) or 1.0
    farthest = 0.0
    for step in np.linspace(1.0, 0.01, ASCENT_STEPS):
        distance = np.linalg.norm(point, axis=-1)
        farthest = max(farthest, float(distance.max()))
        outward = point / np.maximum(distance, 1e-12)[:, None]
        slope = np.einsum("pa,paj->pj", outward, jacobian)
        poses = np.clip(poses + step * slope / scale, low, high)
        point, jacobian = chain.position_and_jacobian(poses)
    return farthest


Severity = Literal["error", "warning", "note"]

SHORT_LEVER_M = 0.01
"""A motor that moves the tool by less for each radian can hardly be watched [m/rad]."""

NAMES_SHOWN = 4

FRAME_MASS_KG = 1e-6
"""Exporters give frames that are no bodies a mass below this and no inertia [kg]."""


@dataclass(frozen=True)
class Finding:
    """One matter that the user should know.

    Attributes:
        severity: ``error``, ``warning`` or ``note``.
        message: What was found and what to do about it.
    """

    severity: Severity
    message: str


def joint_type_findings(root: ElementTree.Element) -> list[Finding]:
    """Return an error for each joint of a type that URDF does not know."""
    valid = MOVING_TYPES + HELD_TYPES
    return [
        Finding(
            "error",
            f"joint {joint.get('name', '')!r}: "
            f"{unknown_name('joint type', joint.get('type', ''), valid)}",
        )
        for joint in root.findall("joint")
        if joint.get("type", "") not in valid
    ]


def name_findings(urdf: Urdf) -> list[Finding]:
    """Return errors for names used twice and warnings for links that are only mentioned."""
    findings = []
    for kind, names in (("link", urdf.links), ("joint", [j.name for j in urdf.joints])):
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice:
            message = f"{kind} {listed(twice)} stands in the file twice. Give each its own name."
            findings.append(Finding("error", message))
    ends = (link for joint in urdf.joints for link in (joint.parent, joint.child))
    absent = [link for link in dict.fromkeys(ends) if link not in urdf.links]
    if absent:
        message = f"link {listed(absent)} is named by a joint but has no <link> element. Add it."
        findings.append(Finding("warning", message))
    return findings


def root_findings(urdf: Urdf, base: str | None) -> list[Finding]:
    """Return what is wrong with the place where the chain begins."""
    found = roots(urdf)
    if not found and base is None:
        message = (
            "no link is a root: every link is the child of a joint, so the joints close a loop. "
            "Name the base with --base LINK, or remove the joint that closes the loop."
        )
        return [Finding("error", message)]
    if len(found) > 1:
        message = f"{len(found)} links hang from no joint: {listed(found)}. A URDF has one root. "
        fix = "Name the base with --base LINK." if base is None else f"The base is {base!r}."
        return [Finding("error" if base is None else "warning", message + fix)]
    return []


def loop_findings(urdf: Urdf, path: Sequence[UrdfJoint]) -> list[Finding]:
    """Return the links that several joints carry: errors where the way to the tool has them."""
    twice = twice_carried(urdf)
    on_path = [joint.child for joint in path if joint.child in twice]
    beside = [link for link in twice if link not in on_path]
    findings = []
    if on_path:
        message = (
            f"link {listed(on_path)} is the child of several joints, which closes a loop on the "
            "way to the tool; only serial chains can be used. Remove all but one of them."
        )
        findings.append(Finding("error", message))
    if beside:
        message = f"link {listed(beside)} is the child of several joints; not on the way to the "
        findings.append(Finding("warning", message + "tool, so it changes nothing."))
    return findings


def tool_findings(candidates: Sequence[Leaf], tool: str, given: bool) -> list[Finding]:
    """Return a note that lists the links that could be the tool, if there are several."""
    if given or len(candidates) < 2:
        return []
    listing = ", ".join(f"{leaf.link} ({leaf.moving} moving)" for leaf in candidates)
    message = (
        f"several branches end in a link that could be the tool: {listing}. Took {tool!r}, the "
        "one with the most moving joints before it; choose another with --tool LINK."
    )
    return [Finding("note", message)]


def joint_findings(path: Sequence[UrdfJoint]) -> list[Finding]:
    """Return what is odd about the joints on the way to the tool."""
    findings: list[Finding] = []
    if not any(is_motor_joint(joint) for joint in path):
        message = (
            "no joint on the way to the tool moves, so there is no motor to watch. Name another "
            "tool with --tool LINK, or check the joint types."
        )
        findings.append(Finding("error", message))
    for joint in path:
        findings += _one_joint(joint)
    return findings


def _one_joint(joint: UrdfJoint) -> list[Finding]:
    name = f"joint {joint.name!r}"
    if joint.type in ("floating", "planar"):
        message = f"{name} is {joint.type} and is held at zero: no single motor can move it."
        return [Finding("warning", message)]
    if joint.type == "fixed":
        return []
    if joint.mimic is not None:
        message = (
            f"{name} follows joint {joint.mimic!r} (mimic), so it is no motor. It lies on the way "
            "to the tool and is held at zero: the tool path is right only where it is zero. "
            "Choose a tool before it with --tool LINK."
        )
        return [Finding("warning", message)]
    findings = []
    if joint.type == "prismatic":
        message = f"{name} slides: its angles and faults are in m where others are in rad."
        findings.append(Finding("warning", message))
    if joint.type == "continuous":
        findings.append(Finding("note", f"{name} turns without end, so a range will be assumed."))
    elif not has_range(joint.low, joint.high):
        stated = "has no limits" if joint.low == -float("inf") else "has no room in its limits"
        message = (
            f"{name} {stated}: a range will be assumed. Add <limit lower=... upper=... "
            "velocity=... effort=.../> to it."
        )
        findings.append(Finding("warning", message))
    return findings


def mimic_findings(urdf: Urdf, path: Sequence[UrdfJoint]) -> list[Finding]:
    """Return a note on joints beside the chain that follow others."""
    on_path = {joint.name for joint in path}
    names = [j.name for j in urdf.joints if j.mimic is not None and j.name not in on_path]
    if not names:
        return []
    message = f"joint {listed(names)} follows another joint (mimic), so it is no motor."
    return [Finding("note", message)]


def lever_findings(motors: Mapping[str, float]) -> list[Finding]:
    """Return a note on each joint that moves the tool only a little.

    Args:
        motors: Largest lever arm by joint name [m/rad or m/m].
    """
    return [
        Finding(
            "note",
            f"joint {name!r} moves the tool by {1e3 * lever:.2g} mm for each rad at most, so "
            "faults of its motor will hardly show. A tool point farther from its axis would help.",
        )
        for name, lever in motors.items()
        if lever < SHORT_LEVER_M
    ]


def mass_findings(
    urdf: Urdf, path: Sequence[UrdfJoint], links: Mapping[str, LinkFacts]
) -> list[Finding]:
    """Return warnings for what gravity cannot be computed of.

    Links held together by fixed joints are one body, so a frame without mass on a heavy link is
    fine; what a moving joint carries has to weigh something.
    """
    bodies = [rigid_body(urdf, joint.child) for joint in path if joint.type != "fixed"]
    facts = {n: links[n] for body in bodies for n in body if n in links}
    not_positive = [n for n, f in facts.items() if f.mass is not None and f.mass <= 0.0]
    weightless = [body[0] for body in bodies if not any(_weighs(facts.get(n)) for n in body)]
    weightless = [name for name in weightless if name not in not_positive]
    heavy = {n: f for n, f in facts.items() if f.mass is not None and f.mass > FRAME_MASS_KG}
    no_inertia = [n for n, f in heavy.items() if not f.has_inertia]
    findings = []
    if not_positive:
        message = f"the mass of link {listed(not_positive)} is not above zero: gravity cannot be "
        findings.append(Finding("warning", message + "computed for it. Kinematics works."))
    if weightless:
        message = f"link {listed(weightless)} has no <inertial> mass: gravity cannot be computed "
        findings.append(Finding("warning", message + "for it. Kinematics works."))
    if no_inertia:
        message = f"link {listed(no_inertia)} has a mass but no moments of inertia above zero: "
        findings.append(Finding("warning", message + "fast motion cannot be computed for it."))
    return findings


def _weighs(facts: LinkFacts | None) -> bool:
    return facts is not None and facts.mass is not None and facts.mass > 0.0


def mesh_findings(links: Mapping[str, LinkFacts], folder: Path) -> list[Finding]:
    """Return what cannot be shown: meshes change no number."""
    meshes = dict.fromkeys(mesh for link in links.values() for mesh in link.meshes)
    remote = [mesh for mesh in meshes if "://" in mesh and not mesh.startswith("file://")]
    local = [mesh for mesh in meshes if mesh not in remote]
    missing = [m for m in local if not (folder / m.removeprefix("file://")).is_file()]
    findings = []
    if remote:
        message = (
            f"{counted(remote, 'mesh')} named by a package address that only ROS can resolve "
            f"({listed(remote)}). Only the picture is missing; kinematics works."
        )
        findings.append(Finding("note", message))
    if missing:
        message = (
            f"{counted(missing, 'mesh')} not found ({listed(missing)}), looked for from {folder}. "
            "Only the picture is missing; kinematics works."
        )
        findings.append(Finding("warning", message))
    return findings


def counted(names: Sequence[str], kind: str) -> str:
    """Return such as ``1 mesh is`` or ``3 meshes are``."""
    return f"1 {kind} is" if len(names) == 1 else f"{len(names)} {kind}es are"


def listed(names: Iterable[str]) -> str:
    """Return the names in quotes, the first few of many."""
    quoted = [repr(name) for name in names]
    more = len(quoted) - NAMES_SHOWN
    shown = ", ".join(quoted[:NAMES_SHOWN])
    return f"{shown} and {more} more" if more > 0 else shown
