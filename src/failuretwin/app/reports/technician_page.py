"""The technician's page: state of the robot, which motor, how surely, what to do; the rest folded.

One file that holds all it shows. Its size is bounded: pictures and details of a few runs, chosen so
that every state is among them, and a row for each of the others. The sketch of the arm comes from
the forward kinematics of its chain,

    T_k = T_k-1 T_pj,k A_k(q_k),    p_k = origin of T_k,    tool p = origin of T_n T_jt

seen from the side: z of the base upwards, and across the horizontal direction in which the origins
spread most. Joints are dots with their number; a marked one is larger, ringed and named.
"""

from __future__ import annotations

import base64
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.app.reports.plots import new_figure, plain, plot_runs, png, render_page
from failuretwin.app.terminal import Table
from failuretwin.core.hypothesis import FAULTY_STATE, HEALTHY_STATE, OPEN_STATE, Diagnosis
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.store import filling
from failuretwin.decision.evaluation import Judged, as_unknown_line, is_right, score_line
from failuretwin.decision.robot_state import RobotState, state_of_run
from failuretwin.digital_model.kinematics import SerialChain
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.explanation import percent

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Sketch of the arm.

APART = 0.05
"""Distance below which joints share a label, as a share of the arm's extent."""
BENT = 0.35
"""Share of the range from its middle by which joints are bent, so that no arm is one line."""
LINKS, JOINTS = "#566069", "#1d2429"
"""Colours of links and of joints without a mark."""


@dataclass(frozen=True)
class Mark:
    """Mark of a joint: colour of ring and label, letter in the ring, label above it."""

    colour: str
    sign: str
    label: str


def joint_places(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Return base, origin of every joint frame and the tool, (joint + 2, 3) [m], base frame.

    Joint values are in chain order, (joint,) [rad or m].
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


def arm_sketch(robot: Robot, marks: Mapping[str, Mark]) -> Figure:
    """Return the sketch; motors without a mark, by their names, are dots with their number."""
    points = seen_from_the_side(joint_places(robot.loads.chain, resting_pose(robot)))
    figure = new_figure(4.0, 3.3)
    panel = figure.add_subplot(aspect="equal", adjustable="datalim")
    panel.axis("off")
    panel.margins(0.22, 0.12)
    panel.plot(*points.T, color=LINKS, lw=5.0, solid_joinstyle="round", zorder=1)
    panel.plot(*points[0], "_", ms=36.0, mew=2.5, color=JOINTS, clip_on=False)
    panel.plot(*points[-1], "+", ms=12.0, mew=2.5, color=JOINTS)
    numbers, rows = defaultdict[int, list[str]](list), Counter[int]()
    for k, (name, place) in enumerate(zip(robot.motor_names, points[1:-1], strict=True)):
        first, mark = _first_at(points[1:-1], k), marks.get(name)
        if mark is None:
            panel.plot(*place, "o", ms=8.0, color=JOINTS)
            numbers[first].append(str(k + 1))
            continue
        panel.plot(*place, "o", ms=20.0, mew=3.5, mfc="white", color=mark.colour, clip_on=False)
        _write(panel, mark.sign, place, (0, -4), "center", mark.colour)
        _write(panel, mark.label, place, (0, 15 + 14 * rows[first]), "center", mark.colour)
        rows[first] += 1
    for k, together in numbers.items():
        _write(panel, ", ".join(together), points[k + 1], (-9, 2), "right", LINKS)
    return figure


def _first_at(points: FloatArray, k: int) -> int:
    """Return the first joint that is drawn at about the same place as joint k."""
    near = np.linalg.norm(points - points[k], axis=1) < APART * np.ptp(points, axis=0).max()
    return int(np.argmax(near))


def _write(
    panel: Axes, text: str, at: FloatArray, offset: tuple[int, int], side: str, colour: str
) -> None:
    """Write a text with a white edge, `offset` points beside a place."""
    from matplotlib.patheffects import withStroke

    edge = [withStroke(linewidth=3.0, foreground="white")]
    style: dict[str, Any] = {"ha": side, "color": colour, "weight": "bold", "path_effects": edge}
    panel.annotate(text, (at[0], at[1]), offset, textcoords="offset points", fontsize=11, **style)


# The page.

MOST_PICTURES = 16
"""Maximum number of runs with a picture and details."""
MOST_PICTURE_BYTES = 3_000_000
"""Maximum size of all pictures of a page together [byte]."""
MOST_ROWS = 2000
"""Maximum number of rows of the table of runs."""
SHOWN = {
    HEALTHY_STATE: ("#2e7d4f", "✓"),
    FAULTY_STATE: ("#c8402f", "!"),
    OPEN_STATE: ("#8a6500", "?"),
}
"""Colour and sign of each state; shapes are in the template."""


@dataclass(frozen=True)
class _Row:
    """A run in the table of runs.

    Attributes:
        number: Its place among the runs, from 1.
        diagnosis: Its diagnosis.
        kind: Its state.
        picture: PNG file in base64; empty: none.
        detailed: Whether it has details below.
    """

    number: int
    diagnosis: Diagnosis
    kind: str
    picture: str
    detailed: bool


@dataclass(frozen=True)
class Section:
    """Section of a page between its motors and its runs.

    Attributes:
        title: Its heading.
        lines: Sentences.
        tables: Tables below them.
        folded: Folded tables below those, by their title.
    """

    title: str
    lines: Sequence[str] = ()
    tables: Sequence[Table] = ()
    folded: Mapping[str, Table] = field(default_factory=dict)


def chosen_runs(diagnoses: Sequence[Diagnosis], robot: Robot, most: int) -> list[int]:
    """Return the runs that are shown in full, in their order.

    Runs are grouped by state, faulty motors and whether their verdict is known to be wrong, and
    taken in turn from each group, the surest first, `most` in all; a right one of every state comes
    before any that is wrong.
    """
    groups: dict[tuple[bool, str, tuple[str, ...]], list[int]] = {}
    for i, diagnosis in enumerate(diagnoses):
        state = state_of_run(diagnosis, robot.motor_names)
        motors = state.motors if state.kind == FAULTY_STATE else ()
        groups.setdefault((is_right(diagnosis) is False, state.kind, motors), []).append(i)
    groups = {key: groups[key] for key in sorted(groups, key=lambda key: key[0])}
    for members in groups.values():
        members.sort(key=lambda i: -(diagnoses[i].probability or 0.0))
    turns = max(map(len, groups.values()), default=0)
    ordered = [g[turn] for turn in range(turns) for g in groups.values() if turn < len(g)]
    return sorted(ordered[:most])


def write_report(
    runs: xr.Dataset,
    diagnoses: Sequence[Diagnosis],
    twin: DigitalTwin,
    state: RobotState,
    folder: Path,
    sections: Sequence[Section] = (),
) -> None:
    """Write the page of diagnosed runs into a folder, with its pictures; see `write_page`."""
    chosen = chosen_runs(diagnoses, twin.robot, MOST_PICTURES)
    with filling(folder) as partial:
        pictures = plot_runs(runs, diagnoses, twin, partial, chosen)
        write_page(diagnoses, state, twin.robot, partial / "index.html", pictures, sections)


def write_page(
    diagnoses: Sequence[Diagnosis],
    state: RobotState,
    robot: Robot,
    path: Path,
    pictures: Mapping[int, Path | None] | None = None,
    sections: Sequence[Section] = (),
) -> None:
    """Write the page of some runs.

    `pictures` are PNG files of the runs with details, by index; None: the first runs have details,
    without pictures.
    """
    judged, marks = Judged.of(diagnoses), _marks(state)
    rows = _rows(diagnoses, pictures or dict.fromkeys(range(MOST_PICTURES)), robot)
    values: dict[str, Any] = {
        "state": state,
        "sketch": png(arm_sketch(robot, marks)),
        "marked": ", ".join(mark.label for mark in marks.values()) or "no joint",
        "shown": SHOWN,
        "rows": rows[:MOST_ROWS],
        "detailed": [row for row in rows if row.detailed],
        "count": len(diagnoses),
        "robot": robot.name,
        "sections": sections,
        "method": diagnoses[0].method,
        "protocol": diagnoses[0].protocol,
        "known": any(d.truth is not None for d in diagnoses),
        "score": score_line(judged),
        "as_unknown": as_unknown_line(judged),
        "is_right": is_right,
        "plain": plain,
        "percent": percent,
    }
    path.write_text(render_page("diagnoses.html.j2", values), encoding="utf-8")


def _marks(state: RobotState) -> dict[str, Mark]:
    """Return how the sketch marks the motors that the state names."""
    if state.state.kind == HEALTHY_STATE:
        return {}
    joints = {row.motor: row.joint for row in state.motors}
    return {motor: Mark(*SHOWN[state.state.kind], joints[motor]) for motor in state.state.motors}


def _rows(
    diagnoses: Sequence[Diagnosis], pictures: Mapping[int, Path | None], robot: Robot
) -> list[_Row]:
    rows, spent = [], 0
    for i, diagnosis in enumerate(diagnoses):
        file = pictures.get(i)
        held = "" if file is None else base64.b64encode(file.read_bytes()).decode("ascii")
        held = held if spent + len(held) <= MOST_PICTURE_BYTES else ""
        spent += len(held)
        kind = state_of_run(diagnosis, robot.motor_names).kind
        rows.append(_Row(i + 1, diagnosis, kind, held, i in pictures))
    return rows
