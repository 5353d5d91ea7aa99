"""What the motion of the runs at hand could not tell, in a line or two."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
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
    single = [h for h in diagnoser.considered if h.known and len(h.faults) <= 1]
    left_out = _left_out_lines([h for h in diagnoser.considered if h not in single])
    if not any(h.faults for h in single):
        return left_out
    if len(single) > MOST_HYPOTHESES:
        return [
            f"which of these {len(single)} hypotheses such motions tell apart may take longer to "
            f"work out than the diagnosis (done for up to {MOST_HYPOTHESES}): call "
            "failuretwin.ambiguity in Python (docs/ambiguity.md), or name fewer with --hypotheses",
            *left_out,
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
    return _group_lines(found) + _size_lines(found) + left_out


def _left_out_lines(others: Sequence[Hypothesis]) -> list[str]:
    """Return the hypotheses that nothing is said of here: pairs of faults, and `unknown`."""
    pairs = sum(len(h.faults) > 1 for h in others)
    names = [f"{pairs} pair{'s' * (pairs > 1)} of faults"] * (pairs > 0)
    names += [str(h) for h in others if not h.known]
    if not names:
        return []
    return [f"what motions tell apart is said of single faults only, not of {' and '.join(names)}"]


def _group_lines(found: Ambiguity) -> list[str]:
    """Return the groups, with the sizes at which their faults look alike."""
    groups = [
        " or ".join(_name(name, found.typical.get(name)) for name in group)
        for group in found.groups
    ]
    if not groups:
        return []
    sized = any(name in found.typical for group in found.groups for name in group)
    when = " when faults are as large as this" if sized else ""
    return [f"cannot be told apart by such motions{when}: {'; '.join(groups)}"]


def _size_lines(found: Ambiguity) -> list[str]:
    """Return the smallest sizes that are found, and what is known of faults never found."""
    hidden = [name for name, size in found.isolated.items() if size is None]
    alarms = {name: found.detected[name] for name in hidden}
    lines = {
        "smallest faults that such motions show": found.isolated,
        "not shown for certain, even when as large as this": {n: found.largest[n] for n in hidden},
        "of these, that something is wrong shows from this size on": alarms,
    }
    return [
        f"{what}: {', '.join(_name(name, size) for name, size in sizes.items() if size)}"
        for what, sizes in lines.items()
        if any(sizes.values())
    ]


def _name(hypothesis: str, size: float | None = None) -> str:
    """Return a hypothesis as a person would say it, with the size of its fault if it has one."""
    parsed = Hypothesis.parse(hypothesis)
    if size is None:
        return plain_name(parsed)
    return plain_name(parsed) + size_words(parsed.faults[0], size).replace("+", "")  # either sign
