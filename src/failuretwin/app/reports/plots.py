"""Pictures of diagnosed runs, and tools of all pages and pictures. Needs the extra `plots`."""

from __future__ import annotations

import base64
import re
import textwrap
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin import __version__
from failuretwin.core.errors import InputError, needs_extra
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.runs import AXES, unique_names
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.store import filling
from failuretwin.decision.evaluation import Evaluation
from failuretwin.decision.scoring import Reliability, Share
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.explanation import plain_name

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MM_PER_M = 1000.0
TITLE_COLUMNS = 100
"""Letters of the title that fit on one line of the picture."""
LONGEST_STEM = 80
"""Maximum length of the name of a picture; file systems take 255 bytes."""
BLUE, RED, GREY = "#1f5f99", "#c8402f", "#9aa3ab"
SMALL: dict[str, Any] = {"fontsize": 8, "frameon": False}
"""How legends look."""


def figure_class() -> Any:
    """Return matplotlib's class of figures."""
    with needs_extra("pictures need matplotlib", "plots"):
        from matplotlib.figure import Figure
    return Figure


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of this size [in] that arranges its panels by itself."""
    made: Figure = figure_class()(figsize=(width, height), layout="constrained")
    return made


def save_figure(figure: Figure, folder: Path, name: str) -> None:
    """Write a figure into a folder as a PNG file."""
    with filling(folder) as partial:
        figure.savefig(partial / name, dpi=130)


def png(figure: Figure) -> str:
    """Return a figure as a PNG file in base64, as pages hold it."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def plot_runs(
    runs: xr.Dataset,
    diagnoses: Sequence[Diagnosis],
    twin: DigitalTwin,
    folder: Path,
    chosen: Sequence[int],
) -> dict[int, Path]:
    """Write a picture of each chosen run into `folder`; return the files by index of the run."""
    time = as_floats(runs["time"].values)
    names = [re.sub(r"[^\w.+-]+", "_", diagnoses[i].run)[:LONGEST_STEM] for i in chosen]
    written = {}
    for i, stem in zip(chosen, unique_names(names), strict=True):
        desired = twin.path(as_floats(runs["command"].values[i]))
        figure = run_figure(time, desired, as_floats(runs["measured"].values[i]), diagnoses[i])
        written[i] = folder / f"{stem}.png"
        figure.savefig(written[i], dpi=110)
    return written


def run_figure(
    time: FloatArray, desired: FloatArray, measured: FloatArray, diagnosis: Diagnosis
) -> Figure:
    """Return the picture of one run: each axis, the distance, and the posterior.

    The path that the commands ask for and the one measured are (time, axis) [m], the latter NaN
    where there is no sample.
    """
    figure = new_figure(11.0, 6.2)
    seen = np.asarray(np.isfinite(measured).all(axis=1))
    shown = slice(0, len(time) - int(np.argmax(seen[::-1])) if seen.any() else len(time))
    time, desired, measured = time[shown], MM_PER_M * desired[shown], MM_PER_M * measured[shown]
    dense = seen[shown].mean() > 0.95
    style: dict[str, Any] = {"lw": 1.2} if dense else {"ls": "none", "marker": ".", "ms": 4}
    grid = figure.add_gridspec(4, 2, width_ratios=[2.1, 1.0])
    *tool, off = (figure.add_subplot(grid[row, 0]) for row in range(4))
    for row, (panel, axis) in enumerate(zip(tool, AXES, strict=True)):
        panel.plot(time, desired[:, row], color=GREY, lw=2.0, label="commanded")
        panel.plot(time, measured[:, row], color=BLUE, label="measured", **style)
        panel.set_ylabel(f"tool {axis} [mm]")
        panel.tick_params(labelbottom=False)
    tool[0].legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=2, **SMALL)
    off.plot(time, np.linalg.norm(measured - desired, axis=1), color=RED, **style)
    off.set(xlabel="time [s]", ylabel="off by [mm]")
    off.set_ylim(bottom=0.0)
    if diagnosis.onset_s:
        off.axvline(diagnosis.onset_s, color="black", lw=1.0, ls="--")
        place = (diagnosis.onset_s, 0.85)
        off.annotate(" fault begins", place, xycoords=("data", "axes fraction"), fontsize=8)
    for panel in (*tool, off):
        panel.set_xlim(-0.02 * time[-1], 1.02 * time[-1])
        clean(panel)
    _plot_posterior(figure.add_subplot(grid[:, 1]), diagnosis)
    truth = "" if diagnosis.truth is None else f"\n(truth: {plain(diagnosis.truth)})"
    title = textwrap.fill(diagnosis.verdict, TITLE_COLUMNS) + truth
    figure.suptitle(title, fontsize=12, fontweight="bold")
    return figure


def _plot_posterior(panel: Axes, diagnosis: Diagnosis) -> None:
    names = list(diagnosis.posterior)[::-1]
    values = [100.0 * diagnosis.posterior[name] for name in names]
    colours = [BLUE if name == diagnosis.diagnosis else GREY for name in names]
    panel.barh(range(len(names)), values, color=colours)
    panel.set_yticks(range(len(names)), [plain(name) for name in names], fontsize=9)
    panel.set(xlim=(0.0, 115.0), xticks=[0, 50, 100], xlabel="probability [%]")
    for y, value in enumerate(values):
        panel.annotate(f"{value:.1f}", (value + 1.5, y), va="center", fontsize=8)
    panel.set_title("what is wrong?", fontsize=10)
    clean(panel)


def plain(hypothesis: str) -> str:
    """Return a hypothesis as people say it."""
    return plain_name(Hypothesis.parse(hypothesis))


def clean(panel: Axes) -> None:
    """Take away the lines of a panel that frame nothing."""
    panel.spines[["top", "right"]].set_visible(False)


# Self-contained HTML pages.


def render_page(template: str, values: Mapping[str, Any]) -> str:
    """Return the page of a template beside this module; text in it is escaped."""
    with needs_extra("pictures need jinja2", "plots"):
        from jinja2 import Environment, PackageLoader, StrictUndefined
    loader = PackageLoader("failuretwin.app", "")
    pages = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    pages.globals["version"] = __version__
    return pages.get_template(template).render(values)


def write_index(template: str, values: Mapping[str, Any], folder: Path) -> Path:
    """Write the page of a template into a folder as `index.html`, and return its path.

    Raises:
        OutputError: If it cannot be written; the folder is as before.
    """
    text = render_page(template, values)
    with filling(folder) as partial:
        (partial / "index.html").write_text(text, encoding="utf-8")
    return folder / "index.html"


# Reliability diagram.


def write_reliability(evaluation: Evaluation, folder: Path) -> None:
    """Write `reliability.png` into `folder`."""
    if evaluation.calibration is None:
        raise InputError("no run got a verdict, so there is no reliability to draw.")
    bins = evaluation.calibration.equal
    figure = new_figure(5.6, 6.4)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[4.0, 1.0])
    _plot_shares(upper, bins)
    lower.bar(bins.edges[:-1], bins.count, np.diff(bins.edges), align="edge", color=GREY, ec="w")
    lower.set(xlabel="stated probability of the verdict", ylabel="runs")
    clean(upper)
    clean(lower)
    figure.suptitle(evaluation.runs_and_protocol, fontsize=11)
    save_figure(figure, folder, "reliability.png")


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
    panel.set(xlim=(0.0, 1.02), ylim=(-0.02, 1.02), ylabel="share of verdicts that are right")
    panel.legend(loc="upper left", **SMALL)
