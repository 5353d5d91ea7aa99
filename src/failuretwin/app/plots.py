"""Pictures of diagnosed runs that a technician understands. Needs the extra `plots`."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.core.diagnosis import Diagnosis
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.runs import AXES, unique_names
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.knowledge import plain_name
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MM_PER_M = 1000.0
TITLE_COLUMNS = 100
"""Letters of the title that fit on one line of the picture."""
BLUE, RED, GREY = "#1f5f99", "#c8402f", "#9aa3ab"


def figure_class() -> Any:
    """Return matplotlib's class of figures.

    Raises:
        InputError: If matplotlib is missing.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError(
            f"pictures need matplotlib ({error}). Install it: pip install 'failuretwin[plots]'."
        ) from error
    return Figure


def plot_runs(
    runs: xr.Dataset, diagnoses: Sequence[Diagnosis], twin: DigitalTwin, folder: Path
) -> list[Path]:
    """Write a picture of each run into `folder`.

    Args:
        runs: The run set.
        diagnoses: Diagnosis of each of its runs, in its order.
        twin: Kinematics, for the path that the commands ask for.
        folder: Where the pictures go.

    Raises:
        InputError: If matplotlib is missing.
    """
    time = as_floats(runs["time"].values)
    written = []
    stems = unique_names([re.sub(r"[^\w.+-]+", "_", diagnosis.run) for diagnosis in diagnoses])
    for i, (diagnosis, stem) in enumerate(zip(diagnoses, stems, strict=True)):
        desired = twin.path(as_floats(runs["command"].values[i]))
        figure = run_figure(time, desired, as_floats(runs["measured"].values[i]), diagnosis)
        path = folder / f"{stem}.png"
        figure.savefig(path, dpi=110)
        written.append(path)
    return written


def run_figure(
    time: FloatArray, desired: FloatArray, measured: FloatArray, diagnosis: Diagnosis
) -> Figure:
    """Return the picture of one run.

    Args:
        time: (time,) [s].
        desired: Path that the commands ask for, (time, axis) [m].
        measured: Tool path, (time, axis) [m], NaN where there is no sample.
        diagnosis: What was found.
    """
    figure = figure_class()(figsize=(11.0, 6.2), layout="constrained")
    seen = np.asarray(np.isfinite(measured).all(axis=1))
    shown = slice(0, len(time) - int(np.argmax(seen[::-1])) if seen.any() else len(time))
    time, desired, measured, seen = time[shown], desired[shown], measured[shown], seen[shown]
    grid = figure.add_gridspec(4, 2, width_ratios=[2.1, 1.0])
    style = {"ls": "-", "lw": 1.2} if seen.mean() > 0.95 else {"ls": "none", "marker": ".", "ms": 4}
    for row, axis in enumerate(AXES):
        panel = figure.add_subplot(grid[row, 0])
        _plot_axis(panel, axis, time, desired[:, row], measured[:, row], style)
        if row == 0:
            panel.legend(
                loc="lower right", bbox_to_anchor=(1.0, 0.98), fontsize=8, ncols=2, frameon=False
            )
    _plot_residual(figure.add_subplot(grid[3, 0]), time, desired, measured, diagnosis, style)
    _plot_posterior(figure.add_subplot(grid[:, 1]), diagnosis)
    truth = "" if diagnosis.truth is None else f"\n(truth: {_plain(diagnosis.truth)})"
    title = textwrap.fill(diagnosis.verdict, TITLE_COLUMNS) + truth
    figure.suptitle(title, fontsize=12, fontweight="bold")
    return figure


def _plot_axis(
    panel: Axes,
    axis: str,
    time: FloatArray,
    desired: FloatArray,
    measured: FloatArray,
    style: Mapping[str, Any],
) -> None:
    panel.plot(time, MM_PER_M * desired, color=GREY, lw=2.0, label="commanded")
    panel.set_xlim(*_span(time))
    panel.plot(time, MM_PER_M * measured, color=BLUE, label="measured", **style)
    panel.set_ylabel(f"tool {axis} [mm]")
    panel.tick_params(labelbottom=False)
    clean(panel)


def _plot_residual(
    panel: Axes,
    time: FloatArray,
    desired: FloatArray,
    measured: FloatArray,
    diagnosis: Diagnosis,
    style: Mapping[str, Any],
) -> None:
    distance = MM_PER_M * np.linalg.norm(measured - desired, axis=1)
    panel.plot(time, distance, color=RED, **style)
    panel.set_xlim(*_span(time))
    panel.set_ylabel("off by [mm]")
    panel.set_xlabel("time [s]")
    panel.set_ylim(bottom=0.0)
    if diagnosis.onset_s:
        panel.axvline(diagnosis.onset_s, color="black", lw=1.0, ls="--")
        panel.annotate(
            " fault begins",
            (diagnosis.onset_s, 0.85),
            xycoords=("data", "axes fraction"),
            fontsize=8,
        )
    clean(panel)


def _plot_posterior(panel: Axes, diagnosis: Diagnosis) -> None:
    names = list(diagnosis.posterior)[::-1]
    values = [100.0 * diagnosis.posterior[name] for name in names]
    colours = [BLUE if name == diagnosis.diagnosis else GREY for name in names]
    panel.barh(range(len(names)), values, color=colours)
    panel.set_yticks(range(len(names)), [_plain(name) for name in names], fontsize=9)
    panel.set_xlim(0.0, 115.0)
    panel.set_xticks([0, 50, 100])
    panel.set_xlabel("probability [%]")
    for y, value in enumerate(values):
        panel.annotate(f"{value:.1f}", (value + 1.5, y), va="center", fontsize=8)
    panel.set_title("what is wrong?", fontsize=10)
    clean(panel)


def _span(time: FloatArray) -> tuple[float, float]:
    """Return the limits of the time axis [s], the same for every panel."""
    margin = 0.02 * float(time[-1])
    return -margin, float(time[-1]) + margin


def _plain(hypothesis: str) -> str:
    return plain_name(Hypothesis.parse(hypothesis))


def clean(panel: Axes) -> None:
    """Take away the lines of a panel that frame nothing."""
    panel.spines[["top", "right"]].set_visible(False)
