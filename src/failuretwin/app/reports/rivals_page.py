"""Table, LaTeX and page of the study of rivals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from failuretwin.app.reports.plots import render_page
from failuretwin.app.reports.reports import latex
from failuretwin.app.reports.study_page import percent
from failuretwin.app.terminal import Table, figures_table
from failuretwin.data_knowledge.store import write_text
from failuretwin.decision.learned.paper_study import Exam, spread_of
from failuretwin.decision.rivals.plan import RivalPlan
from failuretwin.decision.rivals.study import RivalScores
from failuretwin.digital_model.robot import Robot

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
    table, path = rivals_table(scores), folder / "index.html"
    write_text("% \\usepackage{booktabs}\n" + latex(table), folder / "rivals.tex")
    values = {
        "plan": plan,
        "robot": robot.name,
        "test": exam,
        "full": plan == RivalPlan(plan.seed),
        "rivals": table,
        "published": Table(("method", "protocol", "correct [%]"), PUBLISHED_FIGURES),
    }
    write_text(render_page("rivals.html.j2", values), path)
    return path
