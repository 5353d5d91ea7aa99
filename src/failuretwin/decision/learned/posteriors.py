"""From probabilities to diagnoses in words, after a look at the log itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.runs import truth_of
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.explanation import (
    advice_lines,
    percent,
    plain_name,
    possible_hypotheses,
)
from failuretwin.inference.log_quality import LogQuality, drop_invalid, log_quality

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
    chances = judge(drop_invalid(runs, quality))
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
    return (*lines, *advice_lines(possible[0]))


def _possible(diagnosis: Diagnosis) -> Sequence[Hypothesis]:
    ranked = [Hypothesis.parse(name) for name in diagnosis.ranked]
    return possible_hypotheses(diagnosis, ranked)


# Probabilities of two witnesses as one: blended or gated.

LEAST = 1e-300
"""Probabilities that have underflowed count as this, so that a logarithm of them exists."""


@dataclass(frozen=True)
class Weights:
    """How much the log probability of each part counts; 1 and 0: the first part alone."""

    bayes: float
    network: float


def blended(bayes: FloatArray, network: FloatArray, weights: Weights) -> FloatArray:
    """Return the weighted product of probabilities (run, class), normalised."""
    logs = weights.bayes * _log(bayes) + weights.network * _log(network)
    chances = np.exp(logs - logs.max(axis=1, keepdims=True))
    return np.asarray(chances / chances.sum(axis=1, keepdims=True))


def gated(bayes: FloatArray, network: FloatArray, healthy: int) -> FloatArray:
    """Return probabilities (run, class): of healthy by the first, of faults by the second.

    Args:
        bayes: (run, class).
        network: (run, class).
        healthy: Number of the healthy class.
    """
    faults = np.maximum(network, LEAST)
    faults[:, healthy] = 0.0
    rest = 1.0 - bayes[:, [healthy]]
    chances = rest * faults / faults.sum(axis=1, keepdims=True)
    chances[:, healthy] = bayes[:, healthy]
    return chances


def fit_weights(bayes: FloatArray, network: FloatArray, truth: IntArray) -> Weights:
    """Return the weights at which the truth surprises a blend least.

    Args:
        bayes: Probabilities of simulated runs by the model, (run, class).
        network: The same by the network.
        truth: Number of the true class, (run,).
    """
    from scipy.optimize import minimize

    runs = np.arange(len(truth))

    def surprise(values: FloatArray) -> float:
        made = blended(bayes, network, Weights(*values))
        return float(-_log(made)[runs, truth].mean())

    best = minimize(surprise, np.array([0.5, 0.5]), bounds=[(0.0, 3.0)] * 2)
    return Weights(*(float(value) for value in best.x))


def _log(chances: FloatArray) -> FloatArray:
    return np.log(np.maximum(chances, LEAST))


# From scores to probabilities that mean what they say.

RANGE = (0.05, 20.0)
"""Temperatures worth trying."""


def log_probabilities(scores: FloatArray, temperature: float) -> FloatArray:
    """Return the logarithm of the probability of each class, (run, class)."""
    scaled = scores / temperature
    scaled = scaled - scaled.max(axis=1, keepdims=True)
    return np.asarray(scaled - np.log(np.exp(scaled).sum(axis=1, keepdims=True)))


def probabilities(scores: FloatArray, temperature: float) -> FloatArray:
    """Return the probability of each class, (run, class)."""
    return np.exp(log_probabilities(scores, temperature))


def best_temperature(scores: FloatArray, truth: IntArray) -> float:
    """Return the temperature at which the truth surprises least (Guo et al., ICML 2017).

    Args:
        scores: (run, class).
        truth: Number of the true class, (run,).
    """
    from scipy.optimize import minimize_scalar

    runs = np.arange(len(truth))

    def surprise(log_temperature: float) -> float:
        return float(-log_probabilities(scores, np.exp(log_temperature))[runs, truth].mean())

    low, high = np.log(RANGE)
    return float(np.exp(minimize_scalar(surprise, bounds=(low, high), method="bounded").x))
