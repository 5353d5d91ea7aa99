"""Smallest faults that motions show: tables, JSON and picture of `isolability`, and remarks.

`diagnose` prints the remarks, `check` and `design` the sizes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.app.reports.plots import clean, new_figure, save_figure
from failuretwin.app.terminal import Table, figures_table
from failuretwin.core.errors import counted
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.runs import RunSet
from failuretwin.core.types import as_floats
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.explanation import joint_names_in, plain_name, size_words
from failuretwin.inference.isolability import IsolabilityReport, isolability

NARROWEST_IN = 5.0
"""Width of the picture below which its title does not fit [in]."""

# Hypotheses and sizes in words.


def named(name: str, robot: Robot, size: float | None = None) -> str:
    """Return a hypothesis in plain words; None: without the size of its fault."""
    words = "" if size is None else _size_words(name, size, robot)
    return plain_name(Hypothesis.parse(name)) + words


def _size_words(name: str, size: float, robot: Robot) -> str:
    """Return the words for a size that may have either sign."""
    fault = Hypothesis.parse(name).faults[0]
    unit = robot.own_unit(fault.motor, MODES[fault.mode].unit)
    return size_words(fault, size, unit).replace("+", "")


def size_cell(name: str, size: float | None, largest: float, robot: Robot) -> str:
    """Return a size with its unit; None: not even the largest size considered is shown."""
    words = _size_words(name, largest if size is None else size, robot).strip(" ()")
    alone = words.removeprefix("by about ").removeprefix("by ").removeprefix("of ")
    return f"not even {alone}" if size is None else alone


# Tables, JSON and picture.


Sizes = Mapping[str, float | None]
"""Smallest size of each fault by its hypothesis; None: not even the largest considered."""


def size_table(found: IsolabilityReport, robot: Robot) -> Table:
    """Return the smallest sizes told from healthy, and from all other hypotheses."""
    columns = {"told from healthy": found.detected, "told from all others": found.isolated}
    return _table("smallest fault shown", columns, found.largest, robot)


def compared_table(designed: IsolabilityReport, random: IsolabilityReport, robot: Robot) -> Table:
    """Return the smallest sizes that designed and random motions isolate."""
    columns = {"designed": designed.isolated, "random, usual ranges": random.isolated}
    return _table("smallest fault that is told from all others", columns, designed.largest, robot)


def _table(
    heading: str, columns: Mapping[str, Sizes], largest: Mapping[str, float], robot: Robot
) -> Table:
    rows = []
    for name in largest:
        cells = (size_cell(name, sizes[name], largest[name], robot) for sizes in columns.values())
        rows.append([named(name, robot), *cells])
    return figures_table([heading, *columns], rows)


def sizes_of_motor(found: IsolabilityReport, motor: str, robot: Robot) -> str:
    """Return the smallest sizes of each fault of a motor that motions show."""
    return ", ".join(
        size_cell(name, size, found.largest[name], robot)
        for name, size in found.isolated.items()
        if Hypothesis.parse(name).faults[0].motor == motor
    )


def isolability_records(found: IsolabilityReport) -> list[dict[str, Any]]:
    """Return an object for each fault, sizes in the unit of its mode."""
    return [
        {
            "hypothesis": name,
            "unit": MODES[Hypothesis.parse(name).faults[0].mode].unit,
            "detected": found.detected[name],
            "isolated": found.isolated[name],
            "largest": found.largest[name],
        }
        for name in found.isolated
    ]


def save_picture(found: IsolabilityReport, robot: Robot, folder: Path) -> None:
    """Draw the smallest sizes, a panel a mode, as `isolability.png`."""
    modes = list(dict.fromkeys(Hypothesis.parse(name).faults[0].mode for name in found.isolated))
    figure = new_figure(max(3.2 * len(modes), NARROWEST_IN), 2.6)
    for panel, mode in zip(np.ravel(figure.subplots(1, max(len(modes), 1))), modes, strict=False):
        turns = MODES[mode].unit.startswith("rad")
        factor = 180.0 / np.pi if turns else 1.0
        for k, motor in enumerate(robot.motor_names):
            name = f"{motor}:{mode}"
            if name not in found.isolated:
                continue
            for size, colour, width in (
                (found.isolated[name], "#c44e52", 0.7),
                (found.detected[name], "#4c72b0", 0.35),
            ):
                shown = found.largest[name] if size is None else size
                panel.barh(k, factor * shown, width, color=colour, alpha=0.3 if size is None else 1)
        panel.set_yticks(range(len(robot.motor_names)), robot.motor_names)
        unit = MODES[mode].unit.replace("rad", "deg")
        panel.set_title(f"{mode.replace('_', ' ')} [{unit}]", fontsize=9)
        panel.invert_yaxis()
        clean(panel)
    figure.suptitle(
        "smallest fault shown: blue, told from healthy; red, from all others; pale: not even",
        fontsize=8,
    )
    save_figure(figure, folder, "isolability.png")


# Remarks of `diagnose` on the motions of its runs.

MAX_MOTIONS = 3
"""Number of motions that are examined, spread evenly over the runs."""
MAX_COMPARED = 16
"""Maximum number of hypotheses; comparing more takes longer than the diagnosis."""
WITHOUT_RESTS = (
    "which faults motions without rests tell apart takes longer to work out than the diagnosis: "
    "run `failuretwin isolability --motions LOG{options}`"
)


def isolability_summary(runs: RunSet, diagnoser: BayesDiagnoser, options: str = "") -> list[str]:
    """Return which faults such motions cannot tell apart, and the smallest that they show.

    Args:
        runs: Runs with these motions.
        diagnoser: Diagnoser of the runs.
        options: Options of the robot in a command that is named.
    """
    single = [h for h in diagnoser.hypothesis_set if h.known and len(h.faults) <= 1]
    left_out = _left_out_lines([h for h in diagnoser.hypothesis_set if h not in single])
    if not any(h.faults for h in single):
        return left_out
    if len(single) > MAX_COMPARED:
        return [
            f"which of these {len(single)} hypotheses such motions tell apart may take longer to "
            f"work out than the diagnosis (done for up to {MAX_COMPARED}): call "
            "failuretwin.isolability in Python (docs/isolability.md), or name fewer with "
            "--hypotheses",
            *left_out,
        ]
    command = as_floats(runs["command"].values)
    moving = np.flatnonzero(np.ptp(command, axis=1).any(axis=1))
    some = moving[np.unique(np.linspace(0, len(moving) - 1, MAX_MOTIONS).astype(int))]
    settled = diagnoser.seen(runs.isel(run=some)).settled
    if not settled.usable.any():
        return left_out
    if settled.on_the_way.all():
        return [WITHOUT_RESTS.format(options=options), *left_out]
    found = isolability(
        diagnoser.twin,
        command[some],
        as_floats(runs["time"].values),
        imperfections=diagnoser.imperfections,
        hypotheses=single,
        priors=diagnoser.priors,
        onset_s=diagnoser.priors.onset.known_s or 0.0,
    )
    robot = diagnoser.twin.robot
    lines = group_lines(found, robot) + size_lines(found, robot)
    return [joint_names_in(line, robot) for line in lines] + left_out


def _left_out_lines(others: Sequence[Hypothesis]) -> list[str]:
    """Return the hypotheses that nothing is said of here: pairs of faults, and `unknown`."""
    pairs = sum(len(h.faults) > 1 for h in others)
    names = [f"{counted(pairs, 'pair')} of faults"] * (pairs > 0)
    names += [str(h) for h in others if not h.known]
    said = "what motions tell apart is said of single faults only, not of "
    return [said + " and ".join(names)] * bool(names)


def group_lines(found: IsolabilityReport, robot: Robot) -> list[str]:
    """Return the groups, with the sizes at which their faults look alike."""
    if not found.groups:
        return []
    groups = (
        " or ".join(named(n, robot, found.typical.get(n)) for n in group) for group in found.groups
    )
    sized = any(name in found.typical for group in found.groups for name in group)
    when = " when faults are as large as this" if sized else ""
    return [f"cannot be told apart by such motions{when}: {'; '.join(groups)}"]


def onset_lines(found: IsolabilityReport) -> list[str]:
    """Return the onset that the sizes assume; empty unless a motion has no rests."""
    line = (
        "motions without rests: the sizes are for errors that are there from the start; an error "
        "that begins in mid-run shows from smaller sizes on"
    )
    return [line] * found.on_the_way


def size_lines(found: IsolabilityReport, robot: Robot) -> list[str]:
    """Return the smallest sizes that are found, and the bounds of faults never found."""
    hidden = [name for name, size in found.isolated.items() if size is None]
    lines = {
        "smallest faults that such motions show": found.isolated,
        "not shown for certain, even when as large as this": {n: found.largest[n] for n in hidden},
        "of these, that something is wrong shows from this size on": {
            n: found.detected[n] for n in hidden
        },
    }
    return [
        f"{what}: {', '.join(named(name, robot, size) for name, size in sizes.items() if size)}"
        for what, sizes in lines.items()
        if any(sizes.values())
    ]
