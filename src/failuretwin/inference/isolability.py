"""Isolability: which faults a motion can tell apart, and the smallest that show.

Two faults are told apart if the one that is true is expected to be 3 nats ahead at typical size; a
size is found from the one on at which it is 5 nats ahead.

Section: docs/isolability.md#method
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import (
    HEALTHY,
    Fault,
    Hypothesis,
    paper_hypotheses,
    parse_hypotheses,
)
from failuretwin.core.movements import find_movements
from failuretwin.core.progress import Progress, unseen
from failuretwin.core.runs import RunTable
from failuretwin.core.types import BoolArray, FloatArray, as_floats
from failuretwin.digital_model.calibrated_robot import HealthyLike, RobotLike
from failuretwin.digital_model.nonidealities import (
    Imperfections,
    LostCommand,
)
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.failure_behavior.fault import STEP, FaultValue
from failuretwin.failure_behavior.mode import FaultMode, SizedMode
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.expected_bayes_factors import ExpectedLogBayesFactor
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.observation.healthy_model import HealthyModel

if TYPE_CHECKING:
    import xarray as xr

# Faults of given sizes, tried out on some motions: by how much each is ahead of the others.

DRAWS = 8
"""Signs, and which movements are hit, are drawn this often at least, over all motions."""

Case = tuple[Hypothesis, float]
"""A hypothesis and the size of its fault; NaN where it has none."""


@dataclass(frozen=True)
class MonteCarloFaults:
    """Some motions to try faults on.

    Attributes:
        judge: Lays runs beside every hypothesis.
        motions: A run set of the motions, with a reading wherever the tool will be seen.
        onset_s: When faults begin [s].
    """

    judge: ExpectedLogBayesFactor
    motions: xr.Dataset
    onset_s: float

    def log_bayes_factor(self, cases: Sequence[Case]) -> FloatArray:
        """Return by how much the truth beats each hypothesis, (case, hypothesis) [nats].

        It is the median over motions and draws.

        Args:
            cases: What is true, of the judge's hypotheses.
        """
        draws = [(case, draw) for case in cases for draw in range(self._draws(case))]
        rows = [draw % self.motions.sizes["run"] for _, draw in draws]
        faults = [self._faults(case, draw) for case, draw in draws]
        onset = np.full(len(draws), self.onset_s)
        fit = self.judge.fits(self.motions.isel(run=rows), faults, onset)
        own = [self.judge.hypotheses.index(case[0]) for case, _ in draws]
        ahead = fit[np.arange(len(own)), own][:, None] - fit
        ends = np.cumsum([self._draws(case) for case in cases])
        return np.array([np.median(part, axis=0) for part in np.split(ahead, ends[:-1])])

    def _draws(self, case: Case) -> int:
        motions = int(self.motions.sizes["run"])
        return motions if np.isnan(case[1]) else max(motions, DRAWS)

    def _faults(self, case: Case, draw: int) -> list[FaultValue]:
        """Return the faults of one draw; other sizes have the same luck."""
        rng = np.random.default_rng(draw)
        end = float(self.motions["time"].values[-1])
        count = int(self.motions.sizes["movement"])
        hypothesis, size = case
        return [
            self._mode(fault, size).draw(fault.motor, count, end, rng)
            for fault in hypothesis.faults
        ]

    def _mode(self, fault: Fault, size: float) -> FaultMode:
        """Return the mode with one size and one onset, there at once."""
        mode = MODES[fault.mode]
        mode = replace(mode, onset_s=(self.onset_s, self.onset_s))
        if STEP in mode.allowed_profiles:
            mode = replace(mode, profiles=(STEP,))
        return replace(mode, magnitude=(size, size)) if isinstance(mode, SizedMode) else mode


# The smallest size of a fault that a motion shows.

FOUND_NATS = 5.0
"""A fault is found if it is expected to be ahead by this: odds of 150."""
CLOSE = 1.3
"""Ratio of two sizes between which the smallest is interpolated."""
BELOW = 0.25
"""Smallest size tried, as a share of the smallest that is considered."""
LEAST = 0.001
"""No smaller share of the largest size is tried: ranges of errors may begin at 0."""


def minimum_detectable_sizes(
    trials: MonteCarloFaults, hypothesis: Hypothesis, considered: tuple[float, float]
) -> tuple[float | None, float | None]:
    """Return the smallest sizes at which a fault is told from healthy, and from everything else.

    A larger fault shows better: they are found by bisection.

    Args:
        trials: The motions; the first of the judge's hypotheses is healthy.
        hypothesis: One of them, with a size.
        considered: Smallest and largest size that is considered.

    Returns:
        Two sizes; None where the largest is not told either.
    """
    own = trials.judge.hypotheses.index(hypothesis)
    further = needed_nats(trials.judge.priors.healthy_odds) - FOUND_NATS

    @cache
    def ahead(size: float) -> tuple[float, float]:
        (nats,) = trials.log_bayes_factor([(hypothesis, size)])
        nats[own] = np.inf
        nats[0] -= further
        return float(nats[0]), float(nats.min())

    low, high = considered
    ends = max(BELOW * low, LEAST * high), high
    return (
        _smallest(*ends, lambda size: ahead(size)[0]),
        _smallest(*ends, lambda size: ahead(size)[1]),
    )


def _smallest(low: float, high: float, ahead: Callable[[float], float]) -> float | None:
    """Return the size from which on a fault is found; None if the largest is not.

    Args:
        low: The smallest.
        high: The largest.
        ahead: By how much a fault of a size is ahead [nats].
    """
    if ahead(high) < FOUND_NATS:
        return None
    while high > CLOSE * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if ahead(middle) < FOUND_NATS else (low, middle)
    missed, found = ahead(low), ahead(high)
    if missed >= FOUND_NATS:  # the smallest that is tried
        return low
    return low + (FOUND_NATS - missed) / (found - missed) * (high - low)


def needed_nats(healthy_odds: float) -> float:
    """Return by how much a fault must be ahead of healthy on average, to be found as often [nats].

    The lead of what is true scatters by its mean T, with variance 2 T. So that it exceeds log odds
    as often as a lead of F = `FOUND_NATS` exceeds 0,

        T - sqrt(F T) = log odds

    Args:
        healthy_odds: Odds of healthy that a fault has to make up for.
    """
    against = max(0.0, float(np.log(healthy_odds)))
    return 0.25 * float(np.sqrt(FOUND_NATS) + np.sqrt(FOUND_NATS + 4.0 * against)) ** 2


APART_NATS = 3.0
"""Faults are told apart if the true one is expected to be ahead by this: odds of 20."""
SEEN_HZ = 10.0
"""Rate at which the tool is taken to be seen [Hz]."""
LEAST_TYPICAL = 0.02
"""Nothing below this share of the largest size is typical: ranges of errors may begin at 0."""


@dataclass(frozen=True)
class IsolabilityReport:
    """What can be told apart by a motion.

    Attributes:
        hypotheses: Healthy and faults, in the order of `nats`.
        nats: By how much each (row), at typical size, is expected to beat each other (column),
            (hypothesis, hypothesis) [nats]; the median over motions and signs.
        groups: Hypotheses of which no two can be told apart at typical size, as many as can be;
            one may be in several groups.
        detected: Smallest size at which each fault is told from a healthy robot, by hypothesis, in
            the unit of the mode; None: no size considered is. Held angles are no size.
        isolated: Smallest size at which it is told from everything else too.
        typical: Size of each fault that `nats` and `groups` are of, by hypothesis, in the unit of
            the mode; of those that have a size.
        largest: Largest size that is considered, likewise.
        on_the_way: Whether a motion hardly rests, so that moments on the way are compared.
    """

    hypotheses: tuple[str, ...]
    nats: FloatArray
    groups: tuple[tuple[str, ...], ...]
    detected: Mapping[str, float | None]
    isolated: Mapping[str, float | None]
    typical: Mapping[str, float]
    largest: Mapping[str, float]
    on_the_way: bool = False


def isolability(
    twin: RobotLike,
    command: ArrayLike,
    time: ArrayLike,
    imperfections: HealthyLike = None,
    hypotheses: Sequence[Hypothesis | str] | None = None,
    priors: Priors | None = None,
    onset_s: float = 0.0,
    on_progress: Progress = unseen,
) -> IsolabilityReport:
    """Return what a planned motion can tell apart; nothing needs to be measured.

    Args:
        twin: The robot: its twin, itself, its name or its profile.
        command: Reference angles, (time, motor), or of several motions, (motion, time, motor)
            [rad]; each motion is taken as a run of its own.
        time: Uniform time grid from 0, (time,) [s].
        imperfections: How the healthy robot differs from the twin, or a calibration by name or
            path; None: as its profile says.
        hypotheses: What may be the case, single faults, as `Hypothesis` or in the text form, such
            as ``["motor_2:stuck", "motor_2:drift"]``; healthy always may. None: the paper's
            classes.
        priors: Ranges of sizes that are considered; None: the default.
        onset_s: When faults begin [s]; 0: they are there before the motion.
        on_progress: Called with the number of further faults whose smallest size is known.

    Raises:
        InputError: If nothing moves, the shapes do not fit, the onset is not within the motion, or
            a hypothesis has several faults, or cannot be read or weighed.
    """
    model = HealthyModel.of(twin, imperfections)
    motors = model.motor_names
    asked = paper_hypotheses(motors) if hypotheses is None else parse_hypotheses(hypotheses, motors)
    judge = ExpectedLogBayesFactor(
        model, tuple(dict.fromkeys((HEALTHY, *asked))), priors or Priors()
    )
    motions = _motions(model.twin, command, time)
    _check_onset(onset_s, float(motions["time"].values[-1]))
    trials = MonteCarloFaults(judge, motions, onset_s)
    considered = {h: _sizes(h, judge) for h in judge.hypotheses}
    nats = trials.log_bayes_factor([(h, _typical(*sizes)) for h, sizes in considered.items()])
    sized = {h: sizes for h, sizes in considered.items() if np.isfinite(sizes).all()}
    smallest = {}
    for h in judge.hypotheses[1:]:
        if h in sized:
            smallest[str(h)] = minimum_detectable_sizes(trials, h, sized[h])
        on_progress(1)
    names = tuple(str(h) for h in judge.hypotheses)
    return IsolabilityReport(
        hypotheses=names,
        nats=nats,
        groups=_groups(names, nats[1:] < APART_NATS),
        detected={name: found[0] for name, found in smallest.items()},
        isolated={name: found[1] for name, found in smallest.items()},
        typical={str(h): _typical(*sizes) for h, sizes in sized.items()},
        largest={str(h): sizes[1] for h, sizes in sized.items()},
        on_the_way=judge.hardly_rest(motions),
    )


def _check_onset(onset_s: float, end_s: float) -> None:
    """Refuse an onset that is not within a motion that ends at `end_s` [s]."""
    if not 0.0 <= onset_s <= end_s:
        raise InputError(
            f"`onset_s` is {onset_s:g} s, expected a time of the motion: 0 (or before it) to "
            f"{end_s:g} s."
        )


def _motions(twin: DigitalTwin, command: ArrayLike, time: ArrayLike) -> xr.Dataset:
    """Return the motions as a run set whose tool is seen throughout."""
    grid, wanted = as_floats(time), as_floats(command)
    wanted = wanted[None] if wanted.ndim == 2 else wanted
    expected = (len(grid), len(twin.robot.motors))
    if wanted.ndim != 3 or wanted.shape[1:] != expected:
        raise InputError(
            f"`command` has shape {np.shape(command)}, expected (..., {expected[0]} times, "
            f"{expected[1]} motors)."
        )
    movements = find_movements(wanted, grid)
    if movements.start.shape[1] == 0:
        raise InputError(
            "`command` never leaves its first value. Expected a motion of one movement at least."
        )
    return RunTable(
        run=[f"motion {i + 1}" for i in range(len(wanted))],
        motor=twin.robot.motor_names,
        time=grid,
        command=wanted,
        measured=np.zeros((*wanted.shape[:2], 3)),
        measured_rate_hz=SEEN_HZ,
        movements=movements,
    ).to_dataset()


def _sizes(hypothesis: Hypothesis, judge: ExpectedLogBayesFactor) -> tuple[float, float]:
    """Return smallest and largest size that is considered; NaN where there is none."""
    if hypothesis.is_healthy:
        return np.nan, np.nan
    fault, model = hypothesis.faults[0], judge.model
    motor = model.motor_names.index(fault.motor)
    return judge.priors.sizes_of(MODES[fault.mode], model, motor).ends


def _typical(low: float, high: float) -> float:
    """Return the geometric mean of a range of sizes; NaN where there is none."""
    return float(np.sqrt(np.maximum(low, LEAST_TYPICAL * high) * high))


def _groups(names: Sequence[str], alike: BoolArray) -> tuple[tuple[str, ...], ...]:
    """Return the largest groups of hypotheses of which no two are told apart.

    Args:
        names: Healthy, then faults.
        alike: Which faults are not told from which hypotheses, (fault, hypothesis).
    """
    joined = np.zeros((len(names), len(names)), dtype=bool)
    joined[1:] = alike
    joined |= joined.T
    np.fill_diagonal(joined, False)
    neighbours = [set(np.flatnonzero(row).tolist()) for row in joined]
    groups = _cliques(neighbours, set(), set(range(len(names))), set())
    return tuple(
        tuple(names[i] for i in group) for group in sorted(map(sorted, groups)) if len(group) > 1
    )


def _cliques(
    neighbours: Sequence[set[int]], group: set[int], more: set[int], done: set[int]
) -> Iterator[set[int]]:
    """Yield every largest set of mutual neighbours that holds `group` (Bron and Kerbosch, 1973).

    Args:
        neighbours: Neighbours of each member.
        group: Mutual neighbours so far.
        more: Neighbours of them all that may join.
        done: Those that may not: all groups with them were found.
    """
    if not more and not done:
        yield group
        return
    pivot = max(more | done, key=lambda i: len(neighbours[i] & more))
    for i in sorted(more - neighbours[pivot]):
        yield from _cliques(neighbours, group | {i}, more & neighbours[i], done & neighbours[i])
        more, done = more - {i}, done | {i}


# Which runs had better not teach the twin: they look faulty even to a doubtful eye.

MOST_SCATTER_RAD = 0.01
"""Scatter of a motor above which what was learned is taken for errors of faulty runs [rad]."""
MOST_LOST = 0.1
"""A healthy motor loses at most this share of its commands, however often these logs did."""


def fault_probabilities(runs: xr.Dataset, robot: Robot, learned: Imperfections) -> FloatArray:
    """Return the probability that each run is faulty, (run,); 0 where nothing can be told.

    A fit to faulty runs takes their errors for scatter and their stuck motors for lost commands,
    so neither is believed beyond what healthy arms do.

    Args:
        runs: The runs that something was learned from.
        robot: The robot.
        learned: What was learned from them.
    """
    settling = learned.settling
    if settling is not None:
        scatter = tuple(min(value, MOST_SCATTER_RAD) for value in settling.scatter)
        settling = replace(settling, scatter=scatter)
    bounded = replace(
        learned,
        settling=settling,
        lost_commands=tuple(_bounded(entry) for entry in learned.lost_commands),
    )
    diagnoses = BayesDiagnoser(DigitalTwin(robot), imperfections=bounded).diagnose(runs)
    return np.array([0.0 if d.undecided else 1.0 - d.posterior["healthy"] for d in diagnoses])


def _bounded(entry: LostCommand) -> LostCommand:
    return LostCommand(
        entry.motors, min(entry.rate, MOST_LOST), min(entry.rate_when_late, 2.0 * MOST_LOST)
    )
