"""Diagnoses in plain words."""

from __future__ import annotations

import numpy as np

from failuretwin.core.diagnosis import Diagnosis
from failuretwin.decision.evidence import SettledEvidence


def plain_name(hypothesis: str) -> str:
    """Return a hypothesis as a person would say it, such as ``motor 3 stuck``."""
    return hypothesis.replace(":", " ").replace("_", " ").replace("+", " and ")


def percent(probability: float) -> str:
    """Return a probability in per cent that never claims certainty."""
    if probability > 0.999:
        return "over 99.9 %"
    return f"{100 * probability:.1f} %" if probability > 0.99 else f"{100 * probability:.0f} %"


def verdict(diagnosis: Diagnosis, *, enough: bool) -> str:
    """Return the diagnosis as one sentence.

    Args:
        diagnosis: With its estimates filled in.
        enough: Whether the run holds any evidence at all.
    """
    if not enough:
        return "cannot tell, because the tool is not seen at rest after any movement"
    name = diagnosis.diagnosis
    text = plain_name(name)
    if name.endswith(":stuck"):
        text += f" at {np.rad2deg(diagnosis.magnitude or 0.0):.0f} deg {_since(diagnosis.onset_s)}"
    elif name.endswith(":steady_state_error"):
        motor = plain_name(name.partition(":")[0])
        text = (
            f"{motor} misses its targets by about {np.rad2deg(diagnosis.magnitude or 0.0):.1f} deg"
        )
    text += f", {percent(diagnosis.probability)} sure"
    if diagnosis.probability < 0.9 and diagnosis.runner_up is not None:
        share = percent(diagnosis.posterior[diagnosis.runner_up])
        text += f" (or {plain_name(diagnosis.runner_up)}, {share})"
    return text


def _since(onset_s: float | None) -> str:
    return f"since {onset_s:.1f} s" if onset_s else "since before the run"


def quality_of(evidence: SettledEvidence, run: int) -> tuple[str, ...]:
    """Return what keeps movements of a run from being used, a line each."""
    lines = []
    for movement in np.flatnonzero(evidence.movements.exists[run] & ~evidence.usable[run]):
        if evidence.moving[run, movement]:
            reason = "the tool does not come to rest"
        else:
            reason = "no reading while the tool is at rest"
        lines.append(f"movement {movement + 1} not used: {reason}")
    return tuple(lines)
