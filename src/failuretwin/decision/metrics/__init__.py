"""How good diagnoses are, where the truth is known.

One module for each question: right or wrong (`classes`), false alarms (`alarms`), how soon
(`delay`), how much probability (`proper`), whether probabilities mean what they say
(`reliability`, `ranks`, `coverage`), and which of two methods is better (`paired`).
"""

from failuretwin.decision.metrics.classification import (
    NO_VERDICT,
    Alarms,
    ClassScore,
    LogScoreGain,
    McNemar,
    Scores,
    count_alarms,
    judged_truth,
    log_score_gain,
    mcnemar,
    score,
)
from failuretwin.decision.metrics.delay import Delays, alarm_threshold, delays_after_onset
from failuretwin.decision.metrics.probability import (
    Coverage,
    EcdfBand,
    IntervalCase,
    LogScore,
    RankCheck,
    Reliability,
    Share,
    adaptive_edges,
    brier_score,
    calibrated_error,
    check_ranks,
    coverage_by_mode,
    equal_edges,
    log_score,
    rank_of_truth,
    reliability,
    wilson_interval,
)

__all__ = [
    "NO_VERDICT",
    "Alarms",
    "ClassScore",
    "Coverage",
    "Delays",
    "EcdfBand",
    "IntervalCase",
    "LogScore",
    "LogScoreGain",
    "McNemar",
    "RankCheck",
    "Reliability",
    "Scores",
    "Share",
    "adaptive_edges",
    "alarm_threshold",
    "brier_score",
    "calibrated_error",
    "check_ranks",
    "count_alarms",
    "coverage_by_mode",
    "delays_after_onset",
    "equal_edges",
    "judged_truth",
    "log_score",
    "log_score_gain",
    "mcnemar",
    "rank_of_truth",
    "reliability",
    "score",
    "wilson_interval",
]
