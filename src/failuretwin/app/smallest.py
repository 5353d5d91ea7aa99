"""The smallest faults that motions show, as a table, JSON and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.app.reports.check_report import told_size
from failuretwin.app.reports.plots import clean, new_figure
from failuretwin.app.reports.tables import Table, figures_table
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import as_floats
from failuretwin.data_knowledge.store import filling
from failuretwin.decision.test_motions.motions import Motions, holds_motions, read_motions
from failuretwin.decision.test_motions.session import Checking
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.explanation import plain_name
from failuretwin.inference.isolability import IsolabilityReport

MOST_RUNS = 3
"""Runs of a log that are looked at, spread evenly."""
RANDOM_S = 20.0
"""Time of random movements where no motions are given [s]."""
NARROWEST_IN = 5.0
"""The narrowest picture on which its title fits [in]."""


def random_motions(asking: Checking, seconds: float, most: int = 1000) -> Motions:
    """Return random movements within the usual ranges that take so long at most [s]."""
    designer = replace(asking, usual=True).designer
    return Motions.of(asking.known.robot, designer.random(asking.home, seconds, most))


def of_motions(asking: Checking, motions: Motions) -> IsolabilityReport:
    """Return what designed motions can tell apart."""
    time, command = motions.reference()
    return asking.isolability(command, time)


def smallest_of(asking: Checking, path: Path | None) -> IsolabilityReport:
    """Return what the motions of a file can tell apart: designed ones, or those of a log.

    Without a file: the usual random movements.

    Raises:
        InputError: If it cannot be read, or holds no movement.
    """
    if path is None:
        return of_motions(asking, random_motions(asking, RANDOM_S))
    if holds_motions(path, asking.known.robot):
        return of_motions(asking, read_motions(path, asking.known.robot))
    from failuretwin.data_knowledge.readers.read import read_runs

    runs = read_runs(path, asking.known.robot)
    some = np.unique(np.linspace(0, runs.sizes["run"] - 1, MOST_RUNS).astype(np.int64))
    command = as_floats(runs["command"].values)[some]
    time = as_floats(runs["time"].values)
    return asking.isolability(command, time)


def smallest_beside_random(asking: Checking, motions: Motions) -> list[str | Table]:
    """Return the smallest faults that motions show, beside those of random movements."""
    random = random_motions(asking, motions.duration_s, len(motions.orders))
    found = [of_motions(asking, motions), of_motions(asking, random)]
    robot = asking.known.robot
    rows = [
        [plain_name(Hypothesis.parse(name)), *(_said(each, name, robot) for each in found)]
        for name in found[0].isolated
    ]
    return [
        figures_table(
            ["smallest fault that is told from all others", "designed", "random, usual ranges"],
            rows,
        )
    ]


def size_table(found: IsolabilityReport, robot: Robot) -> Table:
    """Return the smallest sizes that are told from healthy, and from everything else."""
    rows = [
        [
            plain_name(Hypothesis.parse(name)),
            told_size(name, found.detected[name], found.largest[name], robot),
            told_size(name, found.isolated[name], found.largest[name], robot),
        ]
        for name in found.isolated
    ]
    return figures_table(
        ["smallest fault shown", "told from healthy", "told from all others"], rows
    )


def _said(found: IsolabilityReport, name: str, robot: Robot) -> str:
    return told_size(name, found.isolated[name], found.largest[name], robot)


def smallest_record(found: IsolabilityReport) -> Sequence[dict[str, Any]]:
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
    """Draw the smallest sizes, a panel a mode, as `isolability.png`.

    Raises:
        OutputError: If it cannot be written.
    """
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
    with filling(folder) as partial:
        figure.savefig(partial / "isolability.png", dpi=130)
