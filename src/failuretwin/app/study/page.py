"""The study as one self-contained HTML page. Needs the extra `plots`."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from failuretwin import __version__
from failuretwin.app.calibration_plots import png
from failuretwin.app.page import environment
from failuretwin.app.study.data import Exam, class_names
from failuretwin.app.study.figures import confusion_figure, path_figure, training_figure
from failuretwin.app.study.plan import FEATURES, PRINTED_RATE, REPRODUCING_RATE, StudyPlan
from failuretwin.app.study.published import RATIOS, TABLE_2, TABLE_3, Spread
from failuretwin.app.study.results import (
    SETS,
    accuracies,
    class_ratios,
    mean_confusion,
    of_kind,
)
from failuretwin.app.study.trainings import Training
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.data_knowledge.knowledge import plain_name
from failuretwin.data_knowledge.store import replacing
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

RATES = (REPRODUCING_RATE, PRINTED_RATE)


def write_study_page(
    trainings: Sequence[Training], plan: StudyPlan, robot: Robot, test: Exam, path: Path
) -> None:
    """Write tables and pictures of a finished study.

    Args:
        trainings: All results.
        plan: What was done.
        robot: The robot.
        test: What was tested on.
        path: HTML file to write.

    Raises:
        InputError: If jinja2 or matplotlib is missing.
    """
    template = (files("failuretwin.app.study") / "study.html.j2").read_text(encoding="utf-8")
    names = class_names(robot)
    text = (
        environment()
        .from_string(template)
        .render(
            plan=plan,
            robot=robot.name,
            version=__version__,
            test=test,
            full=plan == StudyPlan(plan.seed),
            table_2=_table_2(trainings),
            progress=_progress(trainings),
            iterations=plan.checkpoints,
            table_3={name: _table_3(trainings, name, names) for name in FEATURES},
            ratios=RATIOS,
            rates=RATES,
            pictures=_pictures(trainings, robot, test, names),
            minutes=sum(training.seconds for training in trainings) / 60.0,
        )
    )
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _table_2(trainings: Sequence[Training]) -> list[dict[str, Any]]:
    """Return a row for each kind of training and one for the paper."""
    rows = [{"name": "the paper", **{name: percent(TABLE_2[name]) for name in SETS}}]
    for features in reversed(FEATURES):
        for rate in RATES:
            repeats = of_kind(trainings, features, rate)
            last = {name: percent(accuracies(repeats, name)[-1]) for name in SETS}
            rows.append({"name": f"{features} features, learning rate {rate:g}", **last})
    return rows


def _progress(trainings: Sequence[Training]) -> list[dict[str, Any]]:
    """Return accuracies at every checkpoint, a row for each kind of training and set."""
    return [
        {
            "name": f"{features} features, {rate:g}, {name}",
            "cells": [percent(row) for row in accuracies(of_kind(trainings, features, rate), name)],
        }
        for features in FEATURES
        for rate in RATES
        for name in SETS
    ]


def _table_3(
    trainings: Sequence[Training], features: str, names: Sequence[str]
) -> list[dict[str, Any]]:
    """Return ratios of each class at the reproducing rate beside those of the paper."""
    ours = class_ratios(of_kind(trainings, features, REPRODUCING_RATE))
    rows = []
    for name, published in TABLE_3.items():
        if name in names:
            rows.append(
                {
                    "name": plain_name(Hypothesis.parse(name)),
                    "ours": [share(value) for value in ours[names.index(name)]],
                    "published": [share(value) for value in published],
                }
            )
    return rows


def percent(value: Spread) -> str:
    """Return an accuracy with its standard deviation in per cent."""
    if math.isnan(value.deviation):
        return f"{100.0 * value.mean:.2f}"
    return f"{100.0 * value.mean:.2f} ± {100.0 * value.deviation:.2f}"


def share(value: Spread) -> str:
    """Return a ratio with its standard deviation, as the paper writes it."""
    if math.isnan(value.mean):
        return "NaN"
    if math.isnan(value.deviation):
        return f"{value.mean:.2f}"
    return f"{value.mean:.2f} ± {value.deviation:.2f}"


def _pictures(
    trainings: Sequence[Training], robot: Robot, test: Exam, names: Sequence[str]
) -> dict[str, str]:
    published = {name: TABLE_2[name].mean for name in SETS}
    shares = {
        f"{features} features": mean_confusion(of_kind(trainings, features, REPRODUCING_RATE))
        for features in FEATURES
    }
    plain = [plain_name(Hypothesis.parse(name)) for name in names]
    figures = {f"training {rate:g}": training_figure(trainings, rate, published) for rate in RATES}
    figures["path"] = path_figure(test.runs, 0, DigitalTwin(robot))
    figures["confusion"] = confusion_figure(shares, plain)
    return {name: base64.b64encode(png(figure)).decode("ascii") for name, figure in figures.items()}
