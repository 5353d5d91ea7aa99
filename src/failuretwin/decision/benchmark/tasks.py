"""Cases and tasks of the benchmark.

A case is a set of test runs and what may be learned from before; an entry answers it once. A task
is a question, scored on the answers to one or several cases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.hypothesis import SURE, Diagnosis, Hypothesis, motor_probabilities
from failuretwin.core.types import FloatArray
from failuretwin.decision import scoring
from failuretwin.decision.evaluation import Evaluation, Truths, evaluate
from failuretwin.decision.results import Record

if TYPE_CHECKING:
    import xarray as xr

TRACKS = {
    "P0": "no data of the robot",
    "P0c": "healthy logs of the robot",
    "P1": "the test runs themselves, without labels",
    "P2": "labelled runs",
}


@dataclass(frozen=True)
class Case:
    """Test runs, and what an entry may learn from before.

    Attributes:
        test: Name of the set of test runs; `REAL` for recorded ones.
        track: Letter of the track.
        known: Sets that the entry may learn from.
        until_s: Only so much of each run is shown [s]; None: all.
        unknown: Whether an answer may be `unknown`.
    """

    test: str
    track: str
    known: tuple[str, ...] = ()
    until_s: float | None = None
    unknown: bool = False


REAL = "real_robot_b_20241003"
"""Recorded runs of the ArmPi FPV, judged session by session."""
PREFIXES_S = (3.0, 5.0, 7.0)

CASES: Mapping[str, Case] = {
    "robot-P0": Case("robot", "P0"),
    "robot-P0c": Case("robot", "P0c", ("healthy",)),
    "robot-P1": Case("robot", "P1", ("robot",)),
    "robot-P2": Case("robot", "P2", ("healthy", "labelled")),
    "transfer-P2": Case("robot", "P2", ("other",)),
    "class-P0": Case("class", "P0"),
    "ages-P0c": Case("ages", "P0c", ("healthy",)),
    **{f"ages-P0c-{s:g}s": Case("ages", "P0c", ("healthy",), s) for s in PREFIXES_S},
    "sizes-P0c": Case("sizes", "P0c", ("healthy",)),
    "foreign-P0c": Case("foreign", "P0c", ("healthy",), unknown=True),
    "moving-P0": Case("moving", "P0"),
    "moving-P0c": Case("moving", "P0c", ("healthy",)),
    "mistaken-P0": Case("mistaken", "P0"),
    "real-P0": Case(REAL, "P0"),
    "real-P0c": Case(REAL, "P0c", ("healthy",)),
    "real-P1": Case(REAL, "P1", (REAL,)),
}
"""The cases by name."""

Answer = Diagnosis | Record
Answers = Sequence[Answer]


def diagnoses_of(
    runs: xr.Dataset, names: Sequence[str], chances: Iterable[Iterable[float]]
) -> list[Diagnosis]:
    """Return the diagnoses of runs by the probability of each class, (run, class)."""
    return [
        Diagnosis(str(run), dict(zip(names, row, strict=True)))
        for run, row in zip(runs["run"].values, chances, strict=True)
    ]


@dataclass(frozen=True)
class Score:
    """One figure with its 95 % interval; NaN where it does not exist.

    Attributes:
        metric: What is measured, with its unit.
        value: The figure.
        low: Lower end of the interval.
        high: Upper end of the interval.
        runs: Runs behind it.
    """

    metric: str
    value: float
    low: float
    high: float
    runs: int


@dataclass(frozen=True)
class Judgement:
    """Answers to one case with the truth of its runs; `parts` holds other cases of the task."""

    answers: Answers
    truths: Truths
    parts: Mapping[str, Answers]

    @property
    def evaluation(self) -> Evaluation:
        """All scores of the answers."""
        return evaluate(self.answers, self.truths)

    def of(self, answer: Answer) -> str:
        """Return the true fault of the run of an answer."""
        return self.truths[answer.run].fault

    @property
    def healthy(self) -> Answers:
        """Answers to healthy runs."""
        return [answer for answer in self.answers if self.of(answer) == scoring.HEALTHY]

    @property
    def faulty(self) -> Answers:
        """Answers to faulty runs."""
        return [answer for answer in self.answers if self.of(answer) != scoring.HEALTHY]


Scorer = Callable[[Judgement], list[Score]]


# Figures with their intervals.


def _share(metric: str, flags: Sequence[bool]) -> Score:
    share = scoring.Share(int(sum(flags)), len(flags))
    low, high = share.interval
    return Score(metric, 100.0 * share.value, 100.0 * low, 100.0 * high, share.total)


def _mean(metric: str, values: FloatArray) -> Score:
    """Return the mean with its bootstrap interval; infinite values make an infinite mean."""
    if not np.isfinite(values).all():
        return Score(metric, float(np.mean(values)), np.nan, np.nan, len(values))
    gain = scoring.log_score_gain(values, np.zeros_like(values), np.random.default_rng(0))
    return Score(metric, gain.mean, *gain.interval, len(values))


def _median(metric: str, values: FloatArray) -> Score:
    """Return the median with its interval by order statistics."""
    if not len(values):
        return Score(metric, np.nan, np.nan, np.nan, 0)
    ordered, n = np.sort(values), len(values)
    half = 0.98 * np.sqrt(n)  # 1.96 deviations of a binomial of n and one half
    low, high = max(int(np.floor(n / 2 - half)), 0), min(int(np.ceil(n / 2 + half)), n - 1)
    return Score(metric, float(np.median(ordered)), float(ordered[low]), float(ordered[high]), n)


# Scores of each task.


def _is_fault(name: str | None) -> bool:
    return name not in (None, scoring.HEALTHY)


def _false_alarms(judged: Judgement) -> Score:
    return _share("healthy called faulty [%]", [_is_fault(a.diagnosis) for a in judged.healthy])


def _detect(judged: Judgement) -> list[Score]:
    healthy = np.array([a.posterior.get(scoring.HEALTHY, 0.0) for a in judged.answers])
    faulty = np.array([judged.of(a) != scoring.HEALTHY for a in judged.answers])
    with np.errstate(divide="ignore"):  # sums may round above 1
        nats = -np.log(np.clip(np.where(faulty, 1.0 - healthy, healthy), 0.0, 1.0)) + 0.0
    return [
        _false_alarms(judged),
        _share("faulty missed [%]", [not _is_fault(a.diagnosis) for a in judged.faulty]),
        _mean("log score, healthy or not [nats]", nats),
    ]


def _isolate(judged: Judgement) -> list[Score]:
    scores, calibration = judged.evaluation.scores, judged.evaluation.calibration
    error = np.nan if calibration is None else calibration.equal.error
    return [
        _share("correct [%]", judged.evaluation.judged.right.tolist()),
        _mean("log score [nats]", scores.nats),
        Score("calibration error", error, np.nan, np.nan, scores.runs),
    ]


def _interval_scores(quantity: str) -> Scorer:
    field = {"onset": "onset_s", "magnitude": "magnitude"}[quantity]

    def scored(judged: Judgement) -> list[Score]:
        """Return coverage and error of the runs that were named rightly."""
        errors, inside = [], []
        for answer in judged.answers:
            truth = judged.truths[answer.run]
            true, stated = getattr(truth, quantity), getattr(answer, field)
            if answer.diagnosis != truth.fault or not np.isfinite(true) or stated is None:
                continue
            low, high = getattr(answer, f"{quantity}_90") or (stated, stated)
            errors.append(abs(stated - true))
            inside.append(bool(low <= true <= high))
        unit = "s" if quantity == "onset" else "rad"
        return [
            _median(f"error, median [{unit}]", np.array(errors)),
            _share("90 % interval contains the truth [%]", inside),
        ]

    return scored


def _unknown(judged: Judgement) -> list[Score]:
    motors = [(Hypothesis.parse(judged.of(a)).faults[0].motor, a) for a in judged.faulty]
    return [
        _share("called unknown [%]", [a.diagnosis == scoring.UNKNOWN for a in judged.faulty]),
        _share(
            "another motor blamed above 95 % [%]",
            [_blamed(a, without=motor) for motor, a in motors],
        ),
        _false_alarms(judged),
    ]


def _blamed(answer: Answer, without: str = "") -> bool:
    """Return whether any motor but one is blamed with `SURE` probability."""
    motors = motor_probabilities(answer.posterior)
    return any(p >= SURE for motor, p in motors.items() if motor != without)


def _smallest(judged: Judgement) -> list[Score]:
    """Return the share of named faults; the smallest size from which 90 % are named."""
    faulty = judged.faulty
    size = np.array([judged.truths[a.run].magnitude for a in faulty])
    right = np.array([a.diagnosis == judged.of(a) for a in faulty])
    steps = np.unique(np.round(size, 5))
    enough = [right[np.round(size, 5) == step].mean() >= 0.9 for step in steps]
    first = next((i for i in range(len(steps)) if all(enough[i:])), None)
    smallest = np.nan if first is None else np.rad2deg(steps[first])
    below = np.nan if first in (None, 0) else np.rad2deg(steps[first - 1])
    return [
        Score("size from which 90 % are named [deg]", smallest, below, smallest, len(faulty)),
        _share("errors named [%]", right.tolist()),
        _false_alarms(judged),
    ]


def _live(judged: Judgement) -> list[Score]:
    """Return delay and false alarms: an alarm is a motor blamed with `SURE` probability."""
    ends = [*PREFIXES_S, 10.0]
    names = [f"ages-P0c-{end:g}s" for end in PREFIXES_S]
    looks = [{a.run: a for a in judged.parts[name]} for name in names]
    looks.append({a.run: a for a in judged.answers})
    delays, found, false = [], [], []
    for run, truth in judged.truths.by_run.items():
        alarms = [
            (end, look[run].diagnosis)
            for end, look in zip(ends, looks, strict=True)
            if _blamed(look[run]) and (truth.fault == scoring.HEALTHY or end > truth.onset)
        ]
        if truth.fault == scoring.HEALTHY:
            false.append(bool(alarms))
            continue
        right = bool(alarms) and alarms[0][1] == truth.fault
        found.append(right)
        if right:
            delays.append(alarms[0][0] - truth.onset)
    return [
        _median("delay, median [s]", np.array(delays)),
        _share("first alarm names the fault [%]", found),
        _share("healthy runs with an alarm [%]", false),
    ]


def _set_up(judged: Judgement) -> list[Score]:
    truths = [Hypothesis.parse(judged.of(a)).faults for a in judged.answers]
    faulty = [faults[0].motor if faults else "" for faults in truths]
    pairs = list(zip(judged.answers, faulty, strict=True))
    return [
        _share("a wrong motor blamed above 95 % [%]", [_blamed(a, motor) for a, motor in pairs]),
        _share("correct [%]", [a.diagnosis == judged.of(a) for a in judged.answers]),
    ]


@dataclass(frozen=True)
class Task:
    """One question.

    Attributes:
        question: The question.
        cases: Cases that it is scored on, each by itself.
        score: Scores of the answers to one case.
        parts: Further cases that the score needs.
    """

    question: str
    cases: tuple[str, ...]
    score: Scorer
    parts: tuple[str, ...] = ()


_ROBOT = ("robot-P0", "robot-P0c", "robot-P1", "robot-P2")

TASKS: Mapping[str, Task] = {
    "detect": Task("Is the robot faulty?", _ROBOT, _detect),
    "isolate": Task("Which motor failed, and how?", _ROBOT, _isolate),
    "onset": Task("Since when?", ("ages-P0c",), _interval_scores("onset")),
    "size": Task("How large is the fault?", ("ages-P0c",), _interval_scores("magnitude")),
    "unknown": Task("Is it a fault that nobody described?", ("foreign-P0c",), _unknown),
    "smallest": Task("What is the smallest error found?", ("sizes-P0c",), _smallest),
    "live": Task(
        "How soon, and with how many false alarms?",
        ("ages-P0c",),
        _live,
        tuple(f"ages-P0c-{end:g}s" for end in PREFIXES_S),
    ),
    "transfer": Task("Do labelled runs of another robot help?", ("transfer-P2",), _isolate),
    "cold": Task("What if nothing is known of the robot?", ("class-P0",), _isolate),
    "moving": Task("What if the arm never rests?", ("moving-P0", "moving-P0c"), _isolate),
    "set_up": Task("Is a wrong set-up blamed on a motor?", ("mistaken-P0",), _set_up),
    "real": Task("The same of a real arm", ("real-P0", "real-P0c", "real-P1"), _isolate),
}
"""The tasks by name."""
