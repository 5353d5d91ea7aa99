"""What a motion can tell apart: groups of faults that look alike, smallest faults that show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.connection.healthy import HealthyModel
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import HEALTHY, Hypothesis, paper_hypotheses, parse_hypotheses
from failuretwin.core.movements import find_movements
from failuretwin.core.runs import RunTable
from failuretwin.core.types import BoolArray, FloatArray, as_floats
from failuretwin.data_knowledge.knowledge import magnitude_range
from failuretwin.decision.hypotheses.priors import Priors
from failuretwin.decision.telling_apart.separation import Judge
from failuretwin.decision.telling_apart.smallest import smallest_sizes
from failuretwin.decision.telling_apart.trials import Trials
from failuretwin.digital_model.imperfections import Imperfections, default_imperfections
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr

APART_NATS = 3.0
"""Faults are told apart if the true one is expected to be ahead by this: odds of 20."""
SEEN_HZ = 10.0
"""Rate at which the tool is taken to be seen [Hz]."""
LEAST_TYPICAL = 0.02
"""Nothing below this share of the largest size is typical: ranges of errors may begin at 0."""


@dataclass(frozen=True)
class Ambiguity:
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
    """

    hypotheses: tuple[str, ...]
    nats: FloatArray
    groups: tuple[tuple[str, ...], ...]
    detected: Mapping[str, float | None]
    isolated: Mapping[str, float | None]
    typical: Mapping[str, float]
    largest: Mapping[str, float]


def ambiguity(
    twin: DigitalTwin,
    command: ArrayLike,
    time: ArrayLike,
    imperfections: Imperfections | None = None,
    hypotheses: Sequence[Hypothesis | str] | None = None,
    priors: Priors | None = None,
    onset_s: float = 0.0,
) -> Ambiguity:
    """Return what a planned motion can tell apart; nothing needs to be measured.

    Args:
        twin: Digital twin of the robot.
        command: Reference angles, (time, motor), or of several motions, (motion, time, motor)
            [rad]; each motion is taken as a run of its own.
        time: Uniform time grid from 0, (time,) [s].
        imperfections: How the healthy robot differs from the twin; None: as its profile says.
        hypotheses: What may be the case, single faults, as `Hypothesis` or in the text form, such
            as ``["motor_2:stuck", "motor_2:drift"]``; healthy always may. None: the paper's
            classes.
        priors: Ranges of sizes that are considered; None: the default.
        onset_s: When faults begin [s]; 0: they are there before the motion.

    Raises:
        InputError: If nothing moves, the shapes do not fit, the onset is not within the motion, or
            a hypothesis has several faults, or cannot be read or weighed.
    """
    motors = twin.robot.motor_names
    asked = paper_hypotheses(motors) if hypotheses is None else parse_hypotheses(hypotheses, motors)
    model = HealthyModel(twin, imperfections or default_imperfections(twin.robot))
    judge = Judge(model, tuple(dict.fromkeys((HEALTHY, *asked))), priors or Priors())
    motions = _motions(twin, command, time)
    _check_onset(onset_s, float(motions["time"].values[-1]))
    trials = Trials(judge, motions, onset_s)
    considered = {h: _sizes(h, judge.priors) for h in judge.hypotheses}
    nats = trials.ahead([(h, _typical(*sizes)) for h, sizes in considered.items()])
    sized = {h: sizes for h, sizes in considered.items() if np.isfinite(sizes).all()}
    smallest = {str(h): smallest_sizes(trials, h, sizes) for h, sizes in sized.items()}
    names = tuple(str(h) for h in judge.hypotheses)
    return Ambiguity(
        hypotheses=names,
        nats=nats,
        groups=_groups(names, nats[1:] < APART_NATS),
        detected={name: found[0] for name, found in smallest.items()},
        isolated={name: found[1] for name, found in smallest.items()},
        typical={str(h): _typical(*sizes) for h, sizes in sized.items()},
        largest={str(h): sizes[1] for h, sizes in sized.items()},
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


def _sizes(hypothesis: Hypothesis, priors: Priors) -> tuple[float, float]:
    """Return smallest and largest size that is considered; NaN where there is none."""
    if hypothesis.is_healthy or hypothesis.faults[0].mode == "stuck":
        return np.nan, np.nan
    if hypothesis.faults[0].mode == "steady_state_error":
        lows, highs = zip(*priors.error_ranges, strict=True)
        return min(lows), max(highs)
    return magnitude_range(hypothesis.faults[0].mode)


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
