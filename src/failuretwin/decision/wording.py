"""Diagnoses in plain words: the verdict, what speaks for it, what else it may be, what to do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from failuretwin.core.diagnosis import Diagnosis, MovementEvidence
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.data_knowledge.knowledge import failure_modes, plain_name

SURE = 0.95
"""Posterior mass that the hypotheses named as possible hold together."""
TELLING_NATS = 1.0
"""Evidence of a movement worth telling [nats]: it changes the odds by a factor of 2.7."""
SHOWN_UNITS = {
    "rad": (float(np.rad2deg(1.0)), "deg"),
    "rad/s": (float(np.rad2deg(1.0)), "deg/s"),
    "ratio": (100.0, "%"),
    "s": (1.0, "s"),
}
"""How the unit of a magnitude is shown: factor and name."""


def percent(probability: float) -> str:
    """Return a probability in per cent that never claims certainty."""
    if probability > 0.999:
        return "over 99.9 %"
    return f"{100 * probability:.1f} %" if probability > 0.99 else f"{100 * probability:.0f} %"


def verdict(diagnosis: Diagnosis, ranked: Sequence[Hypothesis]) -> str:
    """Return the diagnosis as one sentence.

    Args:
        diagnosis: With its estimates filled in.
        ranked: Its hypotheses from the most to the least probable.
    """
    if diagnosis.undecided:
        return f"cannot tell, because {diagnosis.undecided}"
    best = ranked[0]
    text = plain_name(best)
    if not best.is_healthy:
        text += _size_and_onset(diagnosis, best)
    text += f", {percent(diagnosis.posterior[str(best)])} sure"
    possible = possible_hypotheses(diagnosis, ranked)
    if len(possible) > 1:
        others = [f"{plain_name(h)} {percent(diagnosis.posterior[str(h)])}" for h in possible[1:3]]
        text += f" (or {', '.join(others)})"
    return text


def _size_and_onset(diagnosis: Diagnosis, hypothesis: Hypothesis) -> str:
    if len(hypothesis.faults) != 1 or diagnosis.magnitude is None:
        return ""
    factor, unit = SHOWN_UNITS[hypothesis.faults[0].magnitude_unit]
    size = factor * diagnosis.magnitude
    if hypothesis.faults[0].mode == "stuck":
        since = f"{diagnosis.onset_s:.1f} s" if diagnosis.onset_s else "before the run"
        return f" at {round(size)} {unit} since {since}"
    return f" by about {size:.1f} {unit}"


def possible_hypotheses(diagnosis: Diagnosis, ranked: Sequence[Hypothesis]) -> Sequence[Hypothesis]:
    """Return the fewest hypotheses that together are `SURE`."""
    total = np.cumsum([diagnosis.posterior[str(h)] for h in ranked])
    return ranked[: int(np.searchsorted(total, SURE)) + 1]


def explanation(
    diagnosis: Diagnosis, ranked: Sequence[Hypothesis], losses: Sequence[str]
) -> tuple[str, ...]:
    """Return what speaks for the verdict, what else it may be and what to do, a line each.

    Args:
        diagnosis: With evidence filled in.
        ranked: Its hypotheses from the most to the least probable.
        losses: Commands that seem not to have arrived.
    """
    if diagnosis.undecided:
        return ("Log again, for five movements or more, with the tool in view while it rests.",)
    lines = list(_evidence_lines(diagnosis.evidence, ranked))
    lines += losses
    possible = possible_hypotheses(diagnosis, ranked)
    if len(possible) > 1:
        names = " or ".join(plain_name(h) for h in possible)
        lines.append(f"cannot be told apart in this run: {names}")
    for fault in ranked[0].faults:
        mode = failure_modes()[fault.mode]
        lines.append(f"possible causes: {', '.join(mode.mechanisms)}")
        lines.append(f"what to do: {mode.advice}")
    return tuple(lines)


def _evidence_lines(
    evidence: Sequence[MovementEvidence], ranked: Sequence[Hypothesis]
) -> list[str]:
    if len(ranked) < 2:
        return []
    best, second = plain_name(ranked[0]), plain_name(ranked[1])
    lines = []
    for item in evidence:
        if item.nats >= TELLING_NATS:
            lines.append(f"movement {item.movement}: {item.nats:.1f} nats for {best} over {second}")
        elif item.nats <= -TELLING_NATS:
            lines.append(
                f"movement {item.movement}: {-item.nats:.1f} nats for {second} over {best}"
            )
    return lines
