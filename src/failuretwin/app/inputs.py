"""From what stands on the command line to runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from failuretwin.app.commands.options import LogOptions
from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.bags.reading import BagTopics
from failuretwin.data_knowledge.column_guess import column_map_text, guess_columns
from failuretwin.data_knowledge.column_map import read_column_map
from failuretwin.data_knowledge.matlab_files import RECOVERY_ERROR, RECOVERY_WORST
from failuretwin.data_knowledge.reading import ReadOptions, read_runs
from failuretwin.data_knowledge.session_runs import As
from failuretwin.data_knowledge.store import replacing
from failuretwin.digital_model.imperfections import GENERIC_NAME
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr

TOLD_ERROR_M = 1e-6
"""Error of recovered commands that the user is told of [m]; exact ones are below 1e-9."""


def read_inputs(
    sources: Sequence[Path],
    robot: Robot,
    reading: LogOptions,
) -> xr.Dataset:
    """Return the runs of all inputs as one run set."""
    options = ReadOptions(
        cast(As, reading.how), reading.published_labels, approximate=reading.approximate
    )
    if reading.columns is not None:
        options = _with_map(options, reading.columns, sources, robot)
    runs = read_runs(list(sources), robot, options)
    error = float(runs.attrs.get(RECOVERY_ERROR, 0.0))
    if error > TOLD_ERROR_M:
        click.echo(
            f"note: approximate commands miss the desired path by up to {1000 * error:.1f} mm "
            f"(worst: {runs.attrs[RECOVERY_WORST]}); a diagnosis can be no better than that",
            err=True,
        )
    return runs


def tell_mismatch(runs: xr.Dataset, expected: str) -> None:
    """Tell the user where simulated runs lack the imperfections that a diagnoser expects.

    Args:
        runs: The run set.
        expected: Name of those imperfections.
    """
    made_with = _made_with(runs)
    if made_with is not None and made_with != expected and expected != GENERIC_NAME:
        click.echo(
            f"note: the runs were simulated with imperfections '{made_with}', the diagnosis "
            f"expects '{expected}'; there will be false alarms",
            err=True,
        )


def _made_with(runs: xr.Dataset) -> str | None:
    """Return the imperfections that runs were simulated with; None for any other run set."""
    try:
        configuration = json.loads(runs.attrs.get("configuration", ""))
    except (TypeError, ValueError):  # a run set of other people may say anything there
        return None
    if not isinstance(configuration, dict):
        return None
    made_with = configuration.get("imperfections")
    return made_with if isinstance(made_with, str) else None


def _with_map(
    options: ReadOptions, path: Path, sources: Sequence[Path], robot: Robot
) -> ReadOptions:
    """Return the options with a map of columns or topics.

    Where there is no such file yet, a guess is written and shown, and the work stops.
    """
    if path.exists():
        table = read_toml(path)
        if "topics" in table:
            topics = from_table(BagTopics, table["topics"], f"{path}: topics")
            return replace(options, topics=topics)
        return replace(options, columns=read_column_map(path, robot))
    log = next((s for s in sources if s.is_file() and s.suffix == ".csv"), None)
    if log is None:
        raise InputError(f"{path}: does not exist, and no CSV file is given to guess it from.")
    text = column_map_text(guess_columns(log, robot), log.name, robot)
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")
    click.echo(text)
    raise InputError(
        f"{path} did not exist. The guess above has been written there and nothing was read: check "
        "every line, correct it, and run the same command again."
    )
