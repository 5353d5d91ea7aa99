"""The study, and that of rivals, as self-contained HTML pages. Needs the extra `plots`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.app.reports import plots
from failuretwin.app.reports.plots import BLUE, GREY, MM_PER_M, RED, SMALL
from failuretwin.app.reports.reports import latex
from failuretwin.app.terminal import Table, figures_table
from failuretwin.core.runs import AXES
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.store import write_text
from failuretwin.decision.learned.paper_study import (
    FEATURES,
    RATES,
    REPRODUCING_RATE,
    Exam,
    Spread,
    StudyPlan,
    Training,
    accuracies,
    class_names,
    mean_confusion,
    of_kind,
    ratio_spreads,
    spread_of,
)
from failuretwin.decision.rivals.study import RivalScores
from failuretwin.decision.rivals.training import RivalPlan
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

# Published figures (arXiv 2411.01360, tables II and III).

NONE = Spread(math.nan, math.nan)

TABLE_2 = {
    "training": Spread(0.9812, 0.0171),
    "validation": Spread(0.9244, 0.0041),
    "test": Spread(0.6156, 0.0559),
}
"""Accuracy after 5050 iterations with augmented features."""

RATIOS = ("precision", "recall", "F1")
"""Columns of Table III."""

TABLE_3 = {
    "healthy": (NONE, Spread(0.0, 0.0), NONE),
    "motor_1:steady_state_error": (Spread(1.00, 0.00), Spread(0.52, 0.13), Spread(0.68, 0.11)),
    "motor_1:stuck": (Spread(0.96, 0.06), Spread(0.84, 0.05), Spread(0.89, 0.04)),
    "motor_2:steady_state_error": (Spread(0.49, 0.10), Spread(0.70, 0.10), Spread(0.58, 0.10)),
    "motor_2:stuck": (Spread(0.75, 0.10), Spread(0.92, 0.04), Spread(0.82, 0.06)),
    "motor_3:steady_state_error": (Spread(0.64, 0.08), Spread(0.70, 0.16), Spread(0.66, 0.08)),
    "motor_3:stuck": (Spread(0.64, 0.16), Spread(0.72, 0.11), Spread(0.67, 0.11)),
    "motor_4:steady_state_error": (Spread(0.39, 0.06), Spread(0.68, 0.11), Spread(0.50, 0.07)),
    "motor_4:stuck": (Spread(0.49, 0.11), Spread(0.46, 0.15), Spread(0.47, 0.13)),
}
"""Precision, recall and F1 of each class on 90 real runs, in the order of the paper's rows."""

COLOURS = {"training": GREY, "validation": BLUE, "test": RED}
SETS = tuple(COLOURS)
"""Sets of runs whose accuracy is measured."""

# Figures.


def training_figure(
    trainings: Sequence[Training], learning_rate: float, iterations: Sequence[int]
) -> Figure:
    """Return accuracy by iterations, one panel per feature set, error bars of one deviation.

    Dotted lines show the published accuracies of augmented features.
    """
    figure = plots.new_figure(11.0, 4.2)
    panels = figure.subplots(1, len(FEATURES), sharey=True)
    for panel, features in zip(panels, FEATURES, strict=True):
        repeats = of_kind(trainings, features, learning_rate)
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
                panel.axhline(100.0 * TABLE_2[name].mean, color=COLOURS[name], lw=0.8, ls=":")
        panel.set_title(f"{features} features", fontsize=10)
        panel.set(xlabel="iterations", ylim=(0.0, 102.0))
        plots.clean(panel)
    panels[0].set_ylabel("right [%]")
    panels[0].legend(loc="lower right", **SMALL)
    return figure


def path_figure(runs: xr.Dataset, run: int, twin: DigitalTwin) -> Figure:
    """Return the simulated and measured path of a run, and their difference."""
    time = as_floats(runs["time"].values)
    measured = as_floats(runs["measured"].values[run])
    simulated = twin.path(twin.respond(as_floats(runs["command"].values[run]), time))
    seen = np.isfinite(measured).all(axis=1)
    figure = plots.new_figure(11.0, 5.4)
    panels = figure.subplots(2, len(AXES), sharex=True)
    for column, axis in enumerate(AXES):
        upper, lower = panels[:, column]
        upper.plot(time, MM_PER_M * simulated[:, column], color=GREY, lw=2.0, label="simulated")
        upper.plot(time[seen], MM_PER_M * measured[seen, column], color=BLUE, label="measured")
        upper.set_title(f"{axis} [mm]", fontsize=10)
        residual = MM_PER_M * (measured - simulated)[seen, column]
        lower.plot(time[seen], residual, color=RED)
        lower.set_xlabel("time [s]")
        plots.clean(upper)
        plots.clean(lower)
    panels[0, 0].legend(**SMALL)
    panels[1, 0].set_ylabel("residual [mm]")
    return figure


def confusion_figure(shares: Mapping[str, FloatArray], classes: Sequence[str]) -> Figure:
    """Return confusion matrices of `mean_confusion` side by side, by title."""
    figure = plots.new_figure(6.0 * len(shares), 5.6)
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


# The page.


def write_study_page(
    trainings: Sequence[Training], plan: StudyPlan, robot: Robot, test: Exam, folder: Path
) -> Path:
    """Write the page with tables and figures of a finished study; return its path."""
    names = class_names(robot)
    values = {
        "plan": plan,
        "robot": robot.name,
        "test": test,
        "full": plan == StudyPlan(plan.seed),
        "accuracies": _table_2(trainings, test),
        "progress": _progress(trainings, plan),
        "classes": [_table_3(trainings, features, names) for features in FEATURES],
        "rates": RATES,
        "pictures": _pictures(trainings, plan, robot, test),
        "minutes": sum(training.seconds for training in trainings) / 60.0,
    }
    return plots.write_index("study.html.j2", values, folder)


def _table_2(trainings: Sequence[Training], test: Exam) -> Table:
    """Return one row for the paper and one per kind of training."""
    stand_in = "" if test.real else " (stand-in)"
    rows = [("the paper", *(percent(TABLE_2[name]) for name in SETS))]
    for features in reversed(FEATURES):
        for rate in RATES:
            repeats = of_kind(trainings, features, rate)
            *seen, tested = (percent(accuracies(repeats, name)[-1]) for name in SETS)
            name = f"{features} features, learning rate {rate:g}"
            rows.append((name, *seen, tested + stand_in))
    return Table(("", *SETS), rows)


def _progress(trainings: Sequence[Training], plan: StudyPlan) -> Table:
    """Return accuracies at every checkpoint, one row per kind of training and set."""
    rows = [
        (
            f"{features} features, {rate:g}, {name}",
            *map(percent, accuracies(of_kind(trainings, features, rate), name)),
        )
        for features in FEATURES
        for rate in RATES
        for name in SETS
    ]
    return Table(("features, learning rate, runs", *map(str, plan.checkpoints)), rows)


def _table_3(trainings: Sequence[Training], features: str, names: Sequence[str]) -> Table:
    """Return ratios of each class at the reproducing rate, with those of the paper."""
    ours = ratio_spreads(of_kind(trainings, features, REPRODUCING_RATE))
    rows = [
        (plots.plain(name), *map(text, ours[names.index(name)]), *map(text, published))
        for name, published in TABLE_3.items()
        if name in names
    ]
    headings = ("", *RATIOS, *(f"{ratio}, the paper" for ratio in RATIOS))
    return Table(headings, rows, title=f"{features.capitalize()} features")


def text(value: Spread, scale: float = 1.0) -> str:
    """Return a mean with its standard deviation, as the paper writes it."""
    if math.isnan(value.mean):
        return "NaN"
    mean = f"{scale * value.mean:.2f}"
    return mean if math.isnan(value.deviation) else f"{mean} ± {scale * value.deviation:.2f}"


def percent(value: Spread) -> str:
    """Return an accuracy in percent."""
    return text(value, 100.0)


def _pictures(
    trainings: Sequence[Training], plan: StudyPlan, robot: Robot, test: Exam
) -> dict[str, str]:
    shares = {
        f"{features} features": mean_confusion(of_kind(trainings, features, REPRODUCING_RATE))
        for features in FEATURES
    }
    figures = {
        f"training {rate:g}": training_figure(trainings, rate, plan.checkpoints) for rate in RATES
    }
    figures["path"] = path_figure(test.runs, 0, DigitalTwin(robot))
    figures["confusion"] = confusion_figure(
        shares, [plots.plain(name) for name in class_names(robot)]
    )
    return {name: plots.png(figure) for name, figure in figures.items()}


# Rivals of the paper's network: table, LaTeX and page.

PUBLISHED_FIGURES = (
    ("LSTM, published twin", "P0", "61.56 ± 5.59"),
    ("CNN, published twin", "P0", "70.00"),
    ("DANN", "P1", "80.22"),
    ("TemporalTwinNet", "P1", "86.67"),
    ("LSTM, five-fold transfer", "P2", "83.33 ± 7.86"),
)
"""Accuracy [%] on the authors' own 90 real runs of 2024-10-16; none gives a log score."""


def rivals_table(scores: Sequence[RivalScores]) -> Table:
    """Return a row for each method and twin."""
    rows = []
    for one in scores:
        low, high = one.interval
        gain, *ends = one.gain
        test = "-" if (one.method, one.twin) == ("bayes", "imperfect") else f"{one.p:.2g}"
        rows.append(
            (
                f"{one.method}, {one.twin} twin",
                one.protocol,
                percent(spread_of(one.accuracy)),
                f"{100 * low:.0f} to {100 * high:.0f}",
                f"{spread_of(one.nats).mean:.3f}",
                f"{spread_of(one.errors).mean:.3f}",
                f"{gain:.3f} ({ends[0]:.3f} to {ends[1]:.3f})" if math.isfinite(gain) else "inf",
                test,
                _delay(one),
                f"{one.training_s:.0f}",
                f"{one.run_ms:.1f}",
            )
        )
    headings = (
        *("method", "protocol", "correct [%]", "95 % interval", "log score [nats]", "ECE"),
        *("Bayes saves [nats]", "McNemar p", "delay [s]; named, false [%]"),
        *("training [s]", "a run [ms]"),
    )
    return figures_table(headings, rows)


def _delay(one: RivalScores) -> str:
    named, false = one.alarms
    delay = f"{one.delay_s:.1f}" if math.isfinite(one.delay_s) else "-"
    return f"{delay}; {named:.0f}, {false:.0f}"


def write_rivals(
    scores: Sequence[RivalScores], plan: RivalPlan, robot: Robot, exam: Exam, folder: Path
) -> Path:
    """Write `rivals.tex` and the page; return the path of the page."""
    table = rivals_table(scores)
    write_text("% \\usepackage{booktabs}\n" + latex(table), folder / "rivals.tex")
    values = {
        "plan": plan,
        "robot": robot.name,
        "test": exam,
        "full": plan == RivalPlan(plan.seed),
        "rivals": table,
        "published": Table(("method", "protocol", "correct [%]"), PUBLISHED_FIGURES),
    }
    return plots.write_index("rivals.html.j2", values, folder)
