"""From probabilities to diagnoses in words, after a look at the log itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from failuretwin.core.diagnosis import Diagnosis
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.runs import truth_of
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.knowledge import failure_modes, plain_name
from failuretwin.data_knowledge.log_quality import LogQuality, log_quality, without_spoilt
from failuretwin.decision.wording import percent, possible_hypotheses

if TYPE_CHECKING:
    import xarray as xr


def tell(
    runs: xr.Dataset,
    judge: Callable[[xr.Dataset], FloatArray],
    classes: Sequence[str],
    about: tuple[str, str],
) -> list[Diagnosis]:
    """Return diagnoses from probabilities; a log too poor for a verdict gets none.

    Args:
        runs: The run set.
        judge: Gives the probability of each class, (run, class), of runs without spoilt stretches.
        classes: Names of the classes.
        about: Protocol and method, as results name them.
    """
    quality = log_quality(runs)
    chances = judge(without_spoilt(runs, quality))
    faults = truth_of(runs)
    truth: list[str | None] = [None] * len(chances) if faults is None else list(faults)
    return [
        _diagnosis(str(name), true, dict(zip(classes, map(float, row), strict=True)), log, about)
        for name, true, row, log in zip(runs["run"].values, truth, chances, quality, strict=True)
    ]


def _diagnosis(
    name: str,
    truth: str | None,
    posterior: dict[str, float],
    log: LogQuality,
    about: tuple[str, str],
) -> Diagnosis:
    if log.fatal:  # nothing is learnt, so no class is more probable than another
        posterior = dict.fromkeys(posterior, 1.0 / len(posterior))
    diagnosis = Diagnosis(
        run=name,
        posterior=posterior,
        truth=truth,
        quality=log.remarks,
        undecided=log.fatal,
        protocol=about[0],
        method=about[1],
    )
    if log.fatal:
        return replace(diagnosis, verdict=f"cannot tell, because {log.fatal}")
    return told(diagnosis)


def told(diagnosis: Diagnosis) -> Diagnosis:
    """Return a diagnosis with the words that its probabilities deserve."""
    return replace(diagnosis, verdict=_verdict(diagnosis), explanation=_explanation(diagnosis))


def _verdict(diagnosis: Diagnosis) -> str:
    possible = _possible(diagnosis)
    said = [f"{plain_name(h)}, {percent(diagnosis.posterior[str(h)])} sure" for h in possible[:1]]
    others = [f"{plain_name(h)} {percent(diagnosis.posterior[str(h)])}" for h in possible[1:3]]
    return said[0] + (f" (or {', '.join(others)})" if others else "")


def _explanation(diagnosis: Diagnosis) -> tuple[str, ...]:
    possible = _possible(diagnosis)
    lines = []
    if len(possible) > 1:
        names = " or ".join(plain_name(h) for h in possible)
        lines.append(f"cannot be told apart in this run: {names}")
    for fault in possible[0].faults:
        mode = failure_modes()[fault.mode]
        lines.append(f"possible causes: {', '.join(mode.mechanisms)}")
        lines.append(f"what to do: {mode.advice}")
    return tuple(lines)


def _possible(diagnosis: Diagnosis) -> Sequence[Hypothesis]:
    ranked = [Hypothesis.parse(name) for name in diagnosis.ranked]
    return possible_hypotheses(diagnosis, ranked)
