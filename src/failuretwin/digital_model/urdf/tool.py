"""Which link of a URDF carries the tool: by its name first, never a finger, a camera or an IMU."""

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
"""Names of links that carry a tool, the surest first; a name counts where it stands as a word."""
BESIDE = r"finger|jaw|knuckle|thumb|pad|camera|cam|optical|imu|lidar|laser|sensor|marker|inertial"
"""Names of what hangs on a hand and is no tool."""
HALFWAY = r"shoulder|elbow"
"""Names of places on an arm; their tips are no tools."""
COMPARED = 100
"""Candidates for the tool that are compared with the best one."""
OWN_MOTORS = 2
"""Motors of its own from which another branch is an arm and no finger."""


@dataclass(frozen=True)
class ToolChoice:
    """Which link carries the tool.

    Attributes:
        link: The link; empty where no link can be chosen.
        candidates: Links that could carry it, the best first, with their motors.
        unclear: Whether nothing speaks for the first rather than for the others.
    """

    link: str
    candidates: dict[str, int]
    unclear: bool = False


def choose_tool(urdf: Urdf, base: str) -> ToolChoice:
    """Return which link carries the tool.

    Args:
        urdf: The robot.
        base: Link that carries the base frame.
    """
    ends = {name: count for name, count in urdf.tools(base).items() if not is_beside(name)}
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


def is_beside(link: str) -> bool:
    """Return whether a link is named like something that hangs on a hand and is no tool."""
    return bool(_word(BESIDE, link))


def _word(pattern: str, link: str) -> bool:
    """Return whether a word of a name, which may be numbered or prefixed, is of a pattern."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", link).lower()
    return bool(re.search(rf"(^|[_/.\-\s]|left|right)({pattern})s?\d*([_/.\-\s]|$)", spaced))


def _named(urdf: Urdf, base: str) -> list[str]:
    """Return links with the surest name that moving joints carry, most motors first."""
    ways, surest = urdf.lengths(base), _surest_names(urdf, base)
    if not surest:
        return []
    links = [link for link, rank in surest.items() if rank == min(surest.values())]
    most = max(ways[link][0] for link in links)
    links = [link for link in links if ways[link][0] == most]
    return sorted(links, key=lambda link: (-len(urdf.path(base, link)), -ways[link][1], link))


def _surest_names(urdf: Urdf, base: str) -> dict[str, int]:
    """Return links named like a tool that moving joints carry, and how sure that is, 0 the surest.

    What a motor moves against a body that has no less sure a name is a jaw and left out, unless
    link after link has such a name.
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
    """Return how sure the name of a tool is, 0 the surest; None: it is none."""
    if is_beside(link) or _word(HALFWAY, link):
        return None
    return next((k for k, pattern in enumerate(TOOL_NAMES) if _word(pattern, link)), None)


def _counts(urdf: Urdf, base: str, links: list[str]) -> dict[str, int]:
    return {link: sum(j.has_motor for j in urdf.path(base, link)) for link in links}


def _on_other_arms(urdf: Urdf, base: str, links: list[str]) -> bool:
    """Return whether another candidate hangs on motors of its own, as the first one does."""
    movers = [{j.name for j in urdf.path(base, link) if j.has_motor} for link in links]
    return any(
        len(other - movers[0]) >= OWN_MOTORS and len(movers[0] - other) >= OWN_MOTORS
        for other in movers[1:]
    )


def _before_fingers(urdf: Urdf, base: str) -> dict[str, int]:
    """Return the last links before whatever hangs on them, where all ends are no tools."""
    counts: dict[str, int] = {}
    for link in urdf.tools(base):
        for joint in reversed(urdf.path(base, link)):
            if not is_beside(joint.parent):
                counts |= _counts(urdf, base, [joint.parent])
                break
    length = {
        link: sum(float(np.linalg.norm(j.T_pc[:3, 3])) for j in urdf.path(base, link))
        for link in counts
    }
    return {link: counts[link] for link in sorted(counts, key=lambda k: (-counts[k], -length[k]))}
