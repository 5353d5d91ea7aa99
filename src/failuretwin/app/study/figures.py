"""Pictures of the study. Need the extra `plots`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.app.plots import BLUE, GREY, MM_PER_M, RED, clean, figure_class
from failuretwin.app.study.plan import FEATURES
from failuretwin.app.study.results import SETS, accuracies, of_kind
from failuretwin.app.study.trainings import Training
from failuretwin.core.runs import AXES
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

COLOURS = {"training": GREY, "validation": BLUE, "test": RED}


def training_figure(
    trainings: Sequence[Training], learning_rate: float, published: Mapping[str, float]
) -> Figure:
    """Return accuracy by iterations, a panel for each feature set, with error bars of one sd.

    Args:
        trainings: All results.
        learning_rate: Which of them to show.
        published: Published accuracies by set, drawn as lines in the panel of augmented features.
    """
    figure = figure_class()(figsize=(11.0, 4.2), layout="constrained")
    panels = figure.subplots(1, len(FEATURES), sharey=True)
    for panel, features in zip(panels, FEATURES, strict=True):
        repeats = of_kind(trainings, features, learning_rate)
        iterations = [point.iteration for point in repeats[0].checkpoints]
        for name in SETS:
            rows = accuracies(repeats, name)
            panel.errorbar(
                iterations,
                [100.0 * row.mean for row in rows],
                yerr=np.nan_to_num([100.0 * row.deviation for row in rows]),
                color=COLOURS[name],
                marker="o",
                ms=4,
                capsize=3,
                label=name,
            )
            if features == "augmented":
                panel.axhline(100.0 * published[name], color=COLOURS[name], lw=0.8, ls=":")
        panel.set_title(f"{features} features", fontsize=10)
        panel.set_xlabel("iterations")
        panel.set_ylim(0.0, 102.0)
        clean(panel)
    panels[0].set_ylabel("right [%]")
    panels[0].legend(loc="lower right", fontsize=8, frameon=False)
    return figure


def path_figure(runs: xr.Dataset, run: int, twin: DigitalTwin) -> Figure:
    """Return the simulated and the measured path of a run, and what lies between them.

    Args:
        runs: The test set.
        run: Number of the run in it.
        twin: The published twin.
    """
    time = as_floats(runs["time"].values)
    measured = as_floats(runs["measured"].values[run])
    simulated = twin.path(twin.respond(as_floats(runs["command"].values[run]), time))
    seen = np.isfinite(measured).all(axis=1)
    figure = figure_class()(figsize=(11.0, 5.4), layout="constrained")
    panels = figure.subplots(2, len(AXES), sharex=True)
    for column, axis in enumerate(AXES):
        upper, lower = panels[:, column]
        upper.plot(time, MM_PER_M * simulated[:, column], color=GREY, lw=2.0, label="simulated")
        upper.plot(time[seen], MM_PER_M * measured[seen, column], color=BLUE, label="measured")
        upper.set_title(f"{axis} [mm]", fontsize=10)
        residual = MM_PER_M * (measured - simulated)[seen, column]
        lower.plot(time[seen], residual, color=RED)
        lower.set_xlabel("time [s]")
        clean(upper)
        clean(lower)
    panels[0, 0].legend(fontsize=8, frameon=False)
    panels[1, 0].set_ylabel("residual [mm]")
    return figure


def confusion_figure(shares: Mapping[str, FloatArray], classes: Sequence[str]) -> Figure:
    """Return confusion matrices side by side.

    Args:
        shares: Share of each truth that got each diagnosis, by title, (truth, diagnosis).
        classes: Names of the classes.
    """
    figure = figure_class()(figsize=(6.0 * len(shares), 5.6), layout="constrained")
    panels = figure.subplots(1, len(shares), sharey=True, squeeze=False)[0]
    for panel, (title, share) in zip(panels, shares.items(), strict=True):
        panel.imshow(np.nan_to_num(share), vmin=0.0, vmax=1.0, cmap="Blues")
        for truth, said in np.argwhere(np.nan_to_num(share) > 0.0):
            value = share[truth, said]
            colour = "white" if value > 0.6 else "black"
            text = f"{100.0 * value:.0f}"
            panel.text(said, truth, text, ha="center", va="center", fontsize=7, color=colour)
        panel.set_xticks(range(len(classes)), classes, rotation=60, ha="right", fontsize=7)
        panel.set_yticks(range(len(classes)), classes, fontsize=7)
        panel.set_xlabel("diagnosis")
        panel.set_title(title, fontsize=10)
    panels[0].set_ylabel("truth")
    return figure
