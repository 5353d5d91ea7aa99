"""Tables and page of the benchmark."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from failuretwin.app.reports.plots import write_index
from failuretwin.app.terminal import Table
from failuretwin.decision.benchmark.real import real_sets
from failuretwin.decision.benchmark.runner import REAL_ARM
from failuretwin.decision.benchmark.simulated import ARMS, SETS, VERSION
from failuretwin.decision.benchmark.tasks import CASES, REAL, TASKS, TRACKS

Entry = Mapping[str, Any]

HEADLINES = {
    "detect": "log score, healthy or not [nats]",
    "isolate": "correct [%]",
    "onset": "error, median [s]",
    "size": "error, median [rad]",
    "unknown": "called unknown [%]",
    "smallest": "size from which 90 % are named [deg]",
    "live": "delay, median [s]",
    "transfer": "correct [%]",
    "cold": "correct [%]",
    "moving": "correct [%]",
    "set_up": "a wrong motor blamed above 95 % [%]",
    "real": "correct [%]",
}
"""The figure of each task that the short table shows."""


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def figure(score: Mapping[str, Any]) -> str:
    """Return a score with its interval, where it has one."""
    text = "infinite" if score["infinite"] else _number(score["value"])
    if score["value"] is None or score["low"] is None or score["high"] is None:
        return text
    return f"{text} ({_number(score['low'])} to {_number(score['high'])})"


def score_table(entry: Entry) -> Table:
    """Return all scores of an entry."""
    rows = [
        (s["task"], s["arm"], s["track"], s["metric"], figure(s), str(s["runs"]))
        for s in entry["scores"]
    ]
    headings = ("task", "arm", "track", "score", "value (95 % interval)", "runs")
    return Table(headings, rows, "lllllr")


def _name(entry: Entry) -> str:
    return str(entry.get("name", entry["method"]))


def comparison_tables(entries: Sequence[Entry]) -> list[Table]:
    """Return a table for each task: one row for each arm and track, one column for each entry."""
    tables = []
    for task, metric in HEADLINES.items():
        found: dict[tuple[str, str], dict[int, str]] = {}
        for place, entry in enumerate(entries):
            for score in entry["scores"]:
                if (score["task"], score["metric"]) == (task, metric):
                    where = found.setdefault((score["arm"], score["track"]), {})
                    where[place] = figure(score)
        rows = [
            (arm, track, *(cells.get(place, "-") for place in range(len(entries))))
            for (arm, track), cells in found.items()
        ]
        if rows:
            names = [_name(entry) for entry in entries]
            title = f"{task}: {TASKS[task].question} {metric[0].upper()}{metric[1:]}"
            tables.append(Table(("arm", "track", *names), rows, title=title))
    return tables


def coverage_table(entries: Sequence[Entry]) -> Table:
    """Return how many cases of each arm an entry has scores for."""
    scored = {case for task in TASKS.values() for case in task.cases}
    arms = [(arm, [c for c in scored if CASES[c].test != REAL or arm == REAL_ARM]) for arm in ARMS]
    rows = []
    for entry in entries:
        found = {(score["arm"], score["case"]) for score in entry["scores"]}
        counts = [sum((arm, case) in found for case in cases) for arm, cases in arms]
        rows.append((_name(entry), *map(str, counts)))
    headings = ["entry", *(f"{arm}, of {len(cases)}" for arm, cases in arms)]
    return Table(headings, rows, "l" + "r" * len(arms))


def bundled_entries() -> list[dict[str, Any]]:
    """Return the results of the entries that come with the package."""
    text = (files("failuretwin.decision.benchmark") / "baselines.json").read_text("utf-8")
    stored: list[dict[str, Any]] = json.loads(text)
    return stored


def write_benchmark_page(entries: Sequence[Entry], folder: Path) -> Path:
    """Write the page with these entries beside the bundled ones; return its path."""
    own = {entry["method"] for entry in entries if "name" not in entry}
    every = [*entries, *(e for e in bundled_entries() if e["method"] not in own)]
    sets = [(name, one.content, str(one.runs)) for name, one in SETS.items()]
    real = [
        (name, one.content, f"{one.repository} {one.commit[:7]}", one.licence)
        for name, one in real_sets().items()
    ]
    values = {
        "benchmark": VERSION,
        "tables": comparison_tables(every),
        "details": [(_name(entry), score_table(entry)) for entry in every],
        "coverage": coverage_table(every),
        "tracks": Table(("track", "what may be used"), list(TRACKS.items())),
        "sets": Table(("set", "content", "runs per hypothesis"), sets),
        "real": Table(("set", "content", "source", "licence"), real),
    }
    return write_index("benchmark.html.j2", values, folder)
