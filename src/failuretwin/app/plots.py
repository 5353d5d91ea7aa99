"""Pictures of diagnosed runs that a technician understands. Needs the extra `plots`."""

from __future__ import annotations

import base64
import re
import textwrap
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin import __version__
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.runs import AXES, unique_names
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.store import filling
from failuretwin.decision.evaluation import Evaluation
from failuretwin.decision.metrics import Reliability, Share, judged_truth
from failuretwin.decision.results import as_unknown_line, score_line
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.explanation import plain_name

if TYPE_CHECKING:
    import xarray as xr
    from jinja2 import Environment
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


# One self-contained HTML page for the runs of a folder. Needs the extra `plots`.


def write_page(
    diagnoses: Sequence[Diagnosis], pictures: Sequence[Path], robot: str, path: Path
) -> None:
    """Write the page; pictures are part of it.

    Args:
        diagnoses: Diagnoses of the runs.
        pictures: PNG file of each run, in the same order.
        robot: Name of the robot.
        path: HTML file to write.

    Raises:
        InputError: If jinja2 is missing.
    """
    template = (files("failuretwin.app") / "page.html.j2").read_text(encoding="utf-8")
    page = environment().from_string(template)
    records = [d.to_record() for d in diagnoses]
    text = page.render(
        runs=[_entry(d, picture) for d, picture in zip(diagnoses, pictures, strict=True)],
        robot=robot,
        method=diagnoses[0].method,
        protocol=diagnoses[0].protocol,
        version=__version__,
        known=any(d.truth is not None for d in diagnoses),
        score=score_line(records),
        as_unknown=as_unknown_line(records),
    )
    path.write_text(text, encoding="utf-8")


def environment() -> Environment:
    """Return what renders the templates of pages; text in them is escaped.

    Raises:
        InputError: If jinja2 is missing.
    """
    try:
        from jinja2 import Environment, StrictUndefined
    except ImportError as error:
        raise InputError(
            f"pages need jinja2 ({error}). Install it: pip install 'failuretwin[plots]'."
        ) from error
    return Environment(autoescape=True, undefined=StrictUndefined)


def _entry(diagnosis: Diagnosis, picture: Path) -> dict[str, Any]:
    truth = diagnosis.truth
    return {
        "name": diagnosis.run,
        "verdict": diagnosis.verdict,
        "truth": "" if truth is None else plain_name(Hypothesis.parse(truth)),
        "wrong": truth is not None
        and judged_truth(truth, diagnosis.posterior) != diagnosis.diagnosis,
        "explanation": diagnosis.explanation,
        "quality": diagnosis.quality,
        "picture": base64.b64encode(picture.read_bytes()).decode("ascii"),
    }


# Picture of the reliability diagram. Needs the extra `plots`.

NAME = "reliability.png"
"""Name of the picture in its folder."""


def write_reliability(evaluation: Evaluation, folder: Path) -> None:
    """Write the picture into `folder`.

    Raises:
        InputError: If no run got a verdict, or matplotlib is missing.
    """
    if evaluation.calibration is None:
        raise InputError("no run got a verdict, so there is no reliability to draw.")
    title = f"{evaluation.scores.runs} runs, protocol {evaluation.protocol}"
    figure = reliability_figure(evaluation.calibration.equal, title)
    with filling(folder) as partial:
        figure.savefig(partial / NAME, dpi=130)


def reliability_figure(bins: Reliability, title: str) -> Figure:
    """Return how often verdicts are right by how sure they are, and how many there are.

    Args:
        bins: The reliability diagram.
        title: What it is of.

    Raises:
        InputError: If matplotlib is missing.
    """
    figure = figure_class()(figsize=(5.6, 6.4), layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=[4.0, 1.0])
    upper = figure.add_subplot(grid[0])
    _plot_shares(upper, bins)
    lower = figure.add_subplot(grid[1], sharex=upper)
    lower.bar(bins.edges[:-1], bins.count, np.diff(bins.edges), align="edge", color=GREY, ec="w")
    lower.set_xlabel("stated probability of the verdict")
    lower.set_ylabel("runs")
    for panel in (upper, lower):
        panel.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title, fontsize=11)
    return figure


def _plot_shares(panel: Axes, bins: Reliability) -> None:
    filled = np.flatnonzero(bins.count)
    shares = [Share(int(bins.right[i]), int(bins.count[i])) for i in filled]
    value = np.array([share.value for share in shares])
    low, high = np.array([share.interval for share in shares]).T
    panel.plot([0.0, 1.0], [0.0, 1.0], color=GREY, lw=1.2, ls="--", label="means what it says")
    panel.errorbar(
        bins.confidence[filled],
        value,
        yerr=np.maximum([value - low, high - value], 0.0),  # rounding, at shares of 0 and 1
        color=BLUE,
        marker="o",
        ms=5,
        lw=1.2,
        capsize=3,
        label="share right, 95 % interval",
    )
    panel.set_xlim(0.0, 1.02)
    panel.set_ylim(-0.02, 1.02)
    panel.set_ylabel("share of verdicts that are right")
    panel.tick_params(labelbottom=False)
    panel.legend(loc="upper left", fontsize=8, frameon=False)
