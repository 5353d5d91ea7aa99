"""Does a stated probability happen as often as it says? Reliability and calibration error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray, IntArray

DRAWS = 1000
"""Sets of answers drawn from a method that means what it says."""


@dataclass(frozen=True)
class Reliability:
    """Reliability diagram of the most probable hypothesis.

    A bin holds the runs with low < confidence <= high; the first holds its lower edge too.

    Attributes:
        edges: Edges of the bins, (bins + 1,).
        count: Runs of each bin, (bins,).
        right: Runs of each bin that were diagnosed right, (bins,).
        confidence: Mean stated probability of each bin, (bins,); NaN where it is empty.
    """

    edges: FloatArray
    count: IntArray
    right: IntArray
    confidence: FloatArray

    @property
    def error(self) -> float:
        """Expected calibration error: mean over runs of their bin's |right share - confidence|.

        Naeini et al., AAAI 2015; Guo et al., ICML 2017.
        """
        filled = self.count > 0
        gap = np.abs(self.right[filled] - self.count[filled] * self.confidence[filled])
        return float(gap.sum() / self.count.sum())


def equal_edges(bins: int = 10) -> FloatArray:
    """Return the edges of `bins` bins of equal width from 0 to 1.

    Raises:
        InputError: If there is not one bin at least.
    """
    if bins < 1:
        raise InputError(f"there are {bins} bins, expected 1 or more.")
    return np.linspace(0.0, 1.0, bins + 1)


def adaptive_edges(confidence: FloatArray, bins: int = 10) -> FloatArray:
    """Return edges between which about as many runs lie in each bin (Nixon et al., CVPR 2019).

    Edges lie midway between runs. Runs of equal confidence stay together, so there may be fewer
    bins, and some may be empty.

    Args:
        confidence: Stated probability of each run, (run,).
        bins: Most bins to make.

    Raises:
        InputError: If there is not one bin and one run at least.
    """
    _check_confidence(confidence)
    ordered, sections = np.sort(confidence), min(len(equal_edges(bins)) - 1, len(confidence))
    first = np.ceil(np.arange(1, sections) * len(ordered) / sections).astype(np.int64)
    between = (ordered[first - 1] + ordered[first]) / 2  # no edge lies on a run, but for ties
    return np.r_[0.0, np.unique(between), 1.0]


def reliability(confidence: FloatArray, right: BoolArray, edges: FloatArray) -> Reliability:
    """Sort runs into bins of confidence and count how often they are right.

    Args:
        confidence: Probability of the most probable hypothesis, (run,).
        right: Whether that is the truth, (run,).
        edges: Increasing edges that enclose every confidence, (bins + 1,).

    Raises:
        InputError: If there are no runs, a confidence is not within 0 to 1 or beyond the edges.
    """
    _check_confidence(confidence)
    if confidence.min() < edges[0] or confidence.max() > edges[-1]:
        raise InputError(
            f"confidence runs from {confidence.min():g} to {confidence.max():g}, beyond the edges "
            f"{edges[0]:g} to {edges[-1]:g}. Use equal_edges() or adaptive_edges()."
        )
    inside = _bin_of(confidence, edges)
    bins = len(edges) - 1
    count = np.bincount(inside, minlength=bins)
    total = np.bincount(inside, weights=confidence, minlength=bins)
    mean = np.full(bins, np.nan)
    np.divide(total, count, out=mean, where=count > 0)
    return Reliability(edges, count, np.bincount(inside[right], minlength=bins), mean)


def calibrated_error(
    confidence: FloatArray, edges: FloatArray, rng: np.random.Generator, draws: int = DRAWS
) -> FloatArray:
    """Return the calibration errors that a perfectly calibrated method would show by chance.

    With few runs the error is well above 0 even where every probability is true; compare with
    these (consistency resampling, Broecker & Smith, Weather and Forecasting 2007).

    Args:
        confidence: Stated probability of each run, (run,); taken to be true.
        edges: Edges of the bins, as for `reliability`.
        rng: Source of chance.
        draws: How many sets of answers to draw.

    Returns:
        Expected calibration error of each set, (draws,).
    """
    _check_confidence(confidence)
    inside = _bin_of(confidence, edges)
    order = np.argsort(inside, kind="stable")
    first = np.flatnonzero(np.diff(inside[order], prepend=-1))
    sorted_confidence = confidence[order]
    errors = np.empty(draws)
    for i in range(draws):
        surplus = (rng.random(len(confidence)) < sorted_confidence) - sorted_confidence
        errors[i] = np.abs(np.add.reduceat(surplus, first)).sum() / len(confidence)
    return errors


def _bin_of(confidence: FloatArray, edges: FloatArray) -> IntArray:
    return np.searchsorted(edges[1:-1], confidence, side="left").astype(np.int64)


def _check_confidence(confidence: FloatArray) -> None:
    if confidence.size == 0:
        raise InputError("there are no runs. Expected the confidence of one at least.")
    if not np.all((confidence >= 0.0) & (confidence <= 1.0)):
        raise InputError("confidence holds values outside 0 to 1. Expected probabilities.")
