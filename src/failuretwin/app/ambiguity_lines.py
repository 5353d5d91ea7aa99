"""What the motion of the runs at hand could not tell, in a line or two."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.core.types import as_floats
from failuretwin.data_knowledge.knowledge import plain_name
from failuretwin.decision.bayes import BayesDiagnoser
from failuretwin.decision.telling_apart.ambiguity import Ambiguity, ambiguity
from failuretwin.decision.wording import size_words

if TYPE_CHECKING:
    import xarray as xr

MOST_MOTIONS = 3
"""Motions that are looked at, spread evenly over the runs."""
MOST_HYPOTHESES = 16
"""More hypotheses take longer to tell apart than to diagnose; then the user is left to ask."""


def ambiguity_lines(runs: xr.Dataset, diagnoser: BayesDiagnoser) -> list[str]:
    """Return which faults such motions cannot tell apart, and the smallest that they show.

    Args:
        runs: The runs that were diagnosed.
        diagnoser: Who diagnosed them; of its hypotheses healthy and single faults count.
    """
    asked = diagnoser.hypotheses or paper_hypotheses(diagnoser.twin.robot.motor_names)
    single = [h for h in asked if h.known and len(h.faults) <= 1]
    if not any(h.faults for h in single):
        return []
    if len(single) > MOST_HYPOTHESES:
        return [
            f"which of these {len(single)} hypotheses such motions tell apart: see "
            "failuretwin.ambiguity (docs/ambiguity.md)"
        ]
    command = as_floats(runs["command"].values)
    moving = np.flatnonzero(np.ptp(command, axis=1).any(axis=1))
    some = moving[np.unique(np.linspace(0, len(moving) - 1, MOST_MOTIONS).astype(int))]
    found = ambiguity(
        diagnoser.twin,
        command[some],
        as_floats(runs["time"].values),
        imperfections=diagnoser.imperfections,
        hypotheses=single,
        priors=diagnoser.priors,
        onset_s=diagnoser.priors.onset.known_s or 0.0,
    )
    return _group_lines(found) + _size_lines(found)


def _group_lines(found: Ambiguity) -> list[str]:
    groups = [" or ".join(_name(name) for name in group) for group in found.groups]
    return [f"cannot be told apart by such motions: {'; '.join(groups)}"] if groups else []


def _size_lines(found: Ambiguity) -> list[str]:
    shown, hidden = [], []
    for name, size in found.isolated.items():
        fault = Hypothesis.parse(name).faults[0]
        if size is None:
            hidden.append(_name(name))
        else:
            shown.append(_name(name) + size_words(fault, size))
    lines = []
    if shown:
        lines.append(f"smallest faults that such motions show: {', '.join(shown)}")
    if hidden:
        lines.append(f"not for certain, however large: {', '.join(hidden)}")
    return lines


def _name(hypothesis: str) -> str:
    return plain_name(Hypothesis.parse(hypothesis))
