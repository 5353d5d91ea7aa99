"""Picture of the reliability diagram. Needs the extra `plots`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.app.evaluation import Evaluation
from failuretwin.app.plots import BLUE, GREY, figure_class
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.store import filling
from failuretwin.decision.metrics import Reliability, Share

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
