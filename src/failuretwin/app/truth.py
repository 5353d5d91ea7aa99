"""What was true of the runs of a result file, where a run set or a log knows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.app.results import Record
from failuretwin.core.errors import InputError
from failuretwin.core.runs import truth_of
from failuretwin.data_knowledge.reading import ReadOptions, read_runs

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class RunTruth:
    """The truth of one run; NaN where it is not known or does not apply.

    Attributes:
        fault: True hypothesis.
        onset: When the fault began [s]; 0: before the run.
        magnitude: Size of the fault in the unit of its mode.
    """

    fault: str
    onset: float
    magnitude: float


def read_truths(path: Path, robot: str, published_labels: bool) -> dict[str, RunTruth]:
    """Return the truth of every run of a run set or of raw sessions, by its name.

    Args:
        path: Run set, or whatever else `diagnose` reads.
        robot: Name or profile of the robot that the logs are of.
        published_labels: Take the truth of raw sessions from their folder names.

    Raises:
        InputError: If it cannot be read or knows no truth.
    """
    options = ReadOptions(published_labels=published_labels)
    return truths_of(read_runs(path, robot, options), str(path))


def truths_of(runs: xr.Dataset, where: str) -> dict[str, RunTruth]:
    """Return the truth of every run by its name.

    Args:
        runs: The run set.
        where: What to call it in an error.

    Raises:
        InputError: If it knows no truth.
    """
    faults = truth_of(runs)
    if faults is None:
        raise InputError(
            f"{where}: has no variable `fault`, so it does not know the truth. If the names of raw "
            "sessions end in _label_K, add --published-labels."
        )
    unknown = np.full(len(faults), np.nan)
    onset, magnitude = (runs[n].values if n in runs else unknown for n in ("onset", "magnitude"))
    names = map(str, runs["run"].values)
    return {
        name: RunTruth(fault, float(began), float(size))
        for name, fault, began, size in zip(names, faults, onset, magnitude, strict=True)
    }


def with_truth(
    records: Sequence[Record], truths: Mapping[str, RunTruth], where: str
) -> list[Record]:
    """Return the records with the truth, matched by run name.

    Raises:
        InputError: If the truth of a run is not there.
    """
    for record in records:
        if record["run"] not in truths:
            raise InputError(_no_run(record["run"], truths, where))
    return [{**record, "truth": truths[record["run"]].fault} for record in records]


def _no_run(run: str, truths: Mapping[str, RunTruth], where: str) -> str:
    """Return what is wrong if a run is not there, and why that may be."""
    problem = f"{where}: holds no run {run!r} of the results. "
    name, numbered, _ = run.rpartition("#")
    if numbered and name in truths:
        return problem + (
            f"It holds {name!r}; diagnose numbers runs of the same name, so it was given an input "
            "twice, or several whose runs are called alike. Diagnose and evaluate each input once, "
            "by itself."
        )
    return problem + "Expected the runs that were diagnosed."
