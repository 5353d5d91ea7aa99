"""How good diagnoses are, where the truth is known.

One module for each question: right or wrong (`classes`), false alarms (`alarms`), how soon
(`delay`), how much probability (`proper`), whether probabilities mean what they say
(`reliability`, `ranks`, `coverage`), and which of two methods is better (`paired`).
"""

from failuretwin.decision.metrics.alarms import Alarms, count_alarms
from failuretwin.decision.metrics.classes import (
    NO_VERDICT,
    ClassScore,
    Scores,
    judged_truth,
    score,
)
from failuretwin.decision.metrics.coverage import Coverage, IntervalCase, coverage_by_mode
from failuretwin.decision.metrics.delay import Delays, alarm_threshold, delays_after_onset
from failuretwin.decision.metrics.paired import LogScoreGain, McNemar, log_score_gain, mcnemar
from failuretwin.decision.metrics.proper import LogScore, brier_score, log_score
from failuretwin.decision.metrics.ranks import EcdfBand, RankCheck, check_ranks, rank_of_truth
from failuretwin.decision.metrics.reliability import (
    Reliability,
    adaptive_edges,
    calibrated_error,
    equal_edges,
    reliability,
)
from failuretwin.decision.metrics.shares import Share, wilson_interval

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
