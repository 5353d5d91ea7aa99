"""How soon after its onset a fault is noticed and named, at a stated rate of false alarms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.decision.metrics.probability import Share

ISOLATED = 0.5
"""A fault is isolated once it holds more than this share of the probability of any fault."""


@dataclass(frozen=True)
class Delays:
    """Delays of the faulty runs, in their order.

    Attributes:
        threshold: An alarm is a probability of any fault above this.
        false_alarms: Healthy runs that alarm with it, of all healthy runs.
        detection: From onset to alarm, (faulty run,) [s]; infinite: none before the run ended; NaN:
            the alarm came before the onset, which is a false alarm and no delay.
        isolation: From onset to the first alarm with the right fault in front, (faulty run,) [s];
            infinite and NaN as above.
        followed: From onset to the end of the run, (faulty run,) [s]: a delay that is infinite is
            only known to be longer than this.
    """

    threshold: float
    false_alarms: Share
    detection: FloatArray
    isolation: FloatArray
    followed: FloatArray

    @property
    def early(self) -> Share:
        """Faulty runs with an alarm before the onset, of all faulty runs."""
        return Share(int(np.isnan(self.detection).sum()), len(self.detection))

    @property
    def undetected(self) -> Share:
        """Runs that ended without an alarm, of those without an early one."""
        return _never(self.detection)

    @property
    def unisolated(self) -> Share:
        """Runs that ended without the right fault in front, of those without an early alarm."""
        return _never(self.isolation)

    @property
    def median_detection(self) -> float:
        """Median delay of detection [s], runs that ended too soon counted as censored."""
        return _median(self.detection, self.followed)

    @property
    def median_isolation(self) -> float:
        """Median delay of isolation [s], runs that ended too soon counted as censored."""
        return _median(self.isolation, self.followed)


def alarm_threshold(healthy: FloatArray, share: float) -> float:
    """Return the lowest threshold that at most `share` of the healthy runs ever exceed.

    Args:
        healthy: Probability of any fault, (healthy run, time); NaN: no answer yet.
        share: Stated rate of false alarms [runs with one a run], 0 <= share < 1.

    Raises:
        InputError: If there are no healthy runs or the share is not one.
    """
    if not 0.0 <= share < 1.0:
        raise InputError(f"the rate of false alarms is {share:g}, expected 0 <= rate < 1.")
    if healthy.size == 0:
        raise InputError("there are no healthy runs to set the threshold by.")
    peaks = np.sort(np.max(np.where(np.isnan(healthy), 0.0, healthy), axis=1))[::-1]
    allowed = int(share * len(peaks) + 1e-9)  # 0.29 of 100 is 28.999...
    return float(peaks[allowed])


def delays_after_onset(
    time: FloatArray, fault: FloatArray, true_fault: FloatArray, onset: FloatArray, share: float
) -> Delays:
    """Return the delays at the threshold that keeps false alarms at `share` of the healthy runs.

    Args:
        time: Instants of the answers, (time,) [s].
        fault: Probability of any fault given all data so far, (run, time); NaN: no answer, as
            after the end of the run.
        true_fault: Probability of the true hypothesis, (run, time); not read in healthy runs.
        onset: When the fault began, (run,) [s]; NaN: healthy; 0: before the run.
        share: Stated rate of false alarms [runs with one a run], 0 <= share < 1.

    Raises:
        InputError: If shapes do not fit, or no healthy or no faulty run is there.
    """
    if not fault.shape == true_fault.shape == (len(onset), len(time)):
        raise InputError(
            f"`fault` has shape {fault.shape}, `true_fault` {true_fault.shape}; expected both "
            f"(run, time) = {(len(onset), len(time))}."
        )
    healthy = np.isnan(onset)
    if healthy.all():
        raise InputError("there are no faulty runs to measure delays on.")
    threshold = alarm_threshold(fault[healthy], share)
    alarm = fault > threshold  # False where NaN
    named = alarm & (true_fault > ISOLATED * fault)
    faulty, began = ~healthy, onset[~healthy]
    early = np.any(alarm[faulty] & (time < began[:, None]), axis=1)
    answered = np.where(np.isnan(fault[faulty]), -np.inf, time).max(axis=1)
    return Delays(
        threshold=threshold,
        false_alarms=Share(int(alarm[healthy].any(axis=1).sum()), int(healthy.sum())),
        detection=_first_after(time, alarm[faulty], began, early),
        isolation=_first_after(time, named[faulty], began, early),
        followed=np.maximum(answered - began, 0.0),
    )


def _first_after(
    time: FloatArray, event: BoolArray, onset: FloatArray, early: BoolArray
) -> FloatArray:
    """Return the time from each onset to the first event at or after it [s]."""
    at = np.where(event & (time >= onset[:, None]), time, np.inf).min(axis=1)
    return np.where(early, np.nan, at - onset)


def _never(delay: FloatArray) -> Share:
    valid = delay[~np.isnan(delay)]
    return Share(int(np.isinf(valid).sum()), len(valid))


def _median(delay: FloatArray, followed: FloatArray) -> float:
    """Return where the product-limit curve falls to one half (Kaplan & Meier, JASA 1958) [s].

    Infinite where it never does; NaN where there is no run.
    """
    from scipy.stats import CensoredData, ecdf

    valid = ~np.isnan(delay)
    ended = valid & np.isinf(delay)
    if not valid.any():
        return float("nan")
    if ended.sum() == valid.sum():
        return float("inf")
    data = CensoredData(uncensored=delay[valid & ~ended], right=followed[ended])
    curve = ecdf(data).sf
    low = curve.probabilities <= 0.5 + 1e-12
    return float(curve.quantiles[low.argmax()]) if low.any() else float("inf")
