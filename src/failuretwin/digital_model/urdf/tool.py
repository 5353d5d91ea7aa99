"""Choice of the tool link of a URDF: by its name first, never a finger, a camera or an IMU."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from failuretwin.digital_model.urdf.file import Urdf

TOOL_NAMES = (
    r"tool0",
    r"tcp|tool_?cent(er|re)_?point|grasp(ing)?_?(target|point|frame)",
    r"end_?effector|eef|ee",
    r"tool|tip",
    r"gripper|hand",
    r"flange",
)
"""Names of tool links, the most certain first; a name counts as a whole word."""
BESIDE = r"finger|jaw|knuckle|thumb|pad|camera|cam|optical|imu|lidar|laser|sensor|marker|inertial"
"""Names of parts on a hand that are no tools."""
HALFWAY = r"shoulder|elbow"
"""Names of places on an arm; their tips are no tools."""
COMPARED = 100
"""Number of candidates that are compared with the best one."""
OWN_MOTORS = 2
"""Number of own motors from which another branch is an arm and no finger."""


@dataclass(frozen=True)
class ToolChoice:
    """Chosen tool link.

    Attributes:
        link: The link; empty where none can be chosen.
        candidates: Possible links, the best first, with their numbers of motors.
        unclear: Whether the first candidate is no better than the others.
    """

    link: str
    candidates: dict[str, int]
    unclear: bool = False


def choose_tool(urdf: Urdf, base: str) -> ToolChoice:
    """Return the tool link of a robot with this base link."""
    ends = {name: count for name, count in _tools(urdf, base).items() if not is_beside(name)}
    named = _named(urdf, base)
    if named:
        return ToolChoice(
            named[0], _counts(urdf, base, named), _on_other_arms(urdf, base, named[:COMPARED])
        )
    if not ends:
        ends = _before_fingers(urdf, base)
    links = list(ends)
    link = links[0] if links else base
    return ToolChoice(link, ends, _on_other_arms(urdf, base, links[:COMPARED]))


def _tools(urdf: Urdf, base: str) -> dict[str, int]:
    """Return the end link of every branch above `base` with its number of motors.

    Most motors first; among equals, the longest way along the joint frames.
    """
    ends = set(urdf.links) - {joint.parent for joint in urdf.joints}
    rank = {
        link: (-motors, -round(length, 9), link)
        for link, (motors, length) in _lengths(urdf, base).items()
        if link in ends
    }
    return {link: -rank[link][0] for link in sorted(rank, key=rank.__getitem__)}


def _lengths(urdf: Urdf, base: str) -> dict[str, tuple[int, float]]:
    """Return the number of motors and the length [m] between `base` and each link."""
    known: dict[str, tuple[int, float]] = {}
    for link, joint in urdf.steps(base).items():
        motors, length = known[joint.parent] if joint else (0, 0.0)
        if joint is not None:
            motors += joint.has_motor
            length += float(np.linalg.norm(joint.T_pc[:3, 3]))
        known[link] = motors, length
    return known


def is_beside(link: str) -> bool:
    """Return whether a link has the name of a part on a hand that is no tool."""
    return bool(_word(BESIDE, link))


def _word(pattern: str, link: str) -> bool:
    """Return whether a name, which may be numbered or prefixed, contains a word of a pattern."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", link).lower()
    return bool(re.search(rf"(^|[_/.\-\s]|left|right)({pattern})s?\d*([_/.\-\s]|$)", spaced))


def _named(urdf: Urdf, base: str) -> list[str]:
    """Return links with the most certain name on moving joints, most motors first."""
    ways, surest = _lengths(urdf, base), _surest_names(urdf, base)
    if not surest:
        return []
    links = [link for link, rank in surest.items() if rank == min(surest.values())]
    most = max(ways[link][0] for link in links)
    links = [link for link in links if ways[link][0] == most]
    return sorted(links, key=lambda link: (-len(urdf.path(base, link)), -ways[link][1], link))


def _surest_names(urdf: Urdf, base: str) -> dict[str, int]:
    """Return links on moving joints named like a tool, with ranks, 0 the most certain.

    A link moved by a motor against a body with an equally certain name is a jaw and left out,
    unless link after link has such a name.
    """
    movers: dict[str, tuple[str, ...]] = {}  # of each link: the last three motors before it
    for link, joint in urdf.steps(base).items():
        before = movers[joint.parent] if joint else ()
        movers[link] = (*before, joint.name)[-3:] if joint and joint.has_motor else before
    ranks = {
        link: rank
        for link, motors in movers.items()
        if motors and (rank := _rank(link)) is not None
    }
    bodies: dict[str, int] = {}
    for link, rank in ranks.items():
        body = movers[link][-1]
        bodies[body] = min(rank, bodies.get(body, rank))

    def is_jaw(link: str) -> bool:
        first, hand = ("", "", *movers[link])[-3:-1]
        return hand in bodies and bodies[hand] <= ranks[link] and first not in bodies

    return {link: rank for link, rank in ranks.items() if not is_jaw(link)}


def _rank(link: str) -> int | None:
    """Return the certainty of a tool's name, 0 the most certain; None: no tool."""
    if is_beside(link) or _word(HALFWAY, link):
        return None
    return next((k for k, pattern in enumerate(TOOL_NAMES) if _word(pattern, link)), None)


def _counts(urdf: Urdf, base: str, links: list[str]) -> dict[str, int]:
    return {link: sum(j.has_motor for j in urdf.path(base, link)) for link in links}


def _on_other_arms(urdf: Urdf, base: str, links: list[str]) -> bool:
    """Return whether another candidate is on an arm of its own."""
    movers = [{j.name for j in urdf.path(base, link) if j.has_motor} for link in links]
    return any(
        len(other - movers[0]) >= OWN_MOTORS and len(movers[0] - other) >= OWN_MOTORS
        for other in movers[1:]
    )


def _before_fingers(urdf: Urdf, base: str) -> dict[str, int]:
    """Return the last links before the fingers, where all ends are no tools."""
    counts: dict[str, int] = {}
    for link in _tools(urdf, base):
        for joint in reversed(urdf.path(base, link)):
            if not is_beside(joint.parent):
                counts |= _counts(urdf, base, [joint.parent])
                break
    ways = _lengths(urdf, base)
    order = sorted(counts, key=lambda link: (-counts[link], -ways[link][1]))
    return {link: counts[link] for link in order}
