"""What none of the known faults explains: the best of many other explanations.

Faults that the set leaves out, one motor or two that are off in any regular way or none, and, for
what is nothing of that kind, a healthy robot with far more scatter. Each has odds of its own, and
the best counts alone: many poor explanations are no good one.

    log p(run | unknown) = max over explanations of log odds + log p(run | explanation)

Section: docs/inference.md#hypotheses
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.faults.marginal import Estimate, MarginalLikelihood
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.movements.two_joint_likelihood import (
    LinearOffsets,
    PathFilter,
    TwoJointLikelihood,
    two_joint_likelihood,
)

# How a motor may be off, whatever may have done that: x = centre + slope * amount + noise.


@dataclass(frozen=True)
class OffsetKind:
    """How a motor is off.

    Attributes:
        spread: Deviation of what it is off by: as a share of its range if it is held, in rad if
            it is off by a constant or redrawn, as a ratio if by its angle; 0: it is well.
        held: Whether it stands at one angle whatever the target.
        by_angle: Whether it is off in proportion to its angle.
        redrawn: Whether each movement draws its own.
    """

    spread: float
    held: bool = False
    by_angle: bool = False
    redrawn: bool = False

    @property
    def amount(self) -> bool:
        """Whether it is off by an amount that holds for the run."""
        return self.spread > 0.0 and not self.redrawn


WELL = OffsetKind(0.0)
OFFSET_KINDS: Mapping[str, OffsetKind] = {
    "stuck": OffsetKind(0.4, held=True),
    "encoder_bias": OffsetKind(0.3),
    "encoder_scale": OffsetKind(0.4, by_angle=True),
    "steady_state_error": OffsetKind(0.4, redrawn=True),
}
"""Kinds, by the mode that is the simplest case of each. Spreads are wide enough for most of what a
motor can do within its range."""
OFF = tuple(OFFSET_KINDS.values())
ONE_OFF = (*product(OFF, (WELL,)), *product((WELL,), OFF))
TWO_OFF = tuple(product(OFF, OFF))
KINDS = (*ONE_OFF, *TWO_OFF)
LOG_CHANCE = -np.log([2 * len(ONE_OFF)] * len(ONE_OFF) + [2 * len(TWO_OFF)] * len(TWO_OFF))
"""Log probability of each of `KINDS`: one motor as often as two."""


# What the runs say of one motor or two being off anyhow.


def unmodelled_offsets_likelihood(
    likelihood: RunLikelihood, known: Sequence[Hypothesis] = ()
) -> MarginalLikelihood | None:
    """Return what the runs say of one motor or two being off; None of an arm of a single motor.

    Args:
        likelihood: The runs.
        known: Hypotheses; two motors that are off as one of them says are left out.
    """
    pairs = list(combinations(range(len(likelihood.model.scatter)), 2))
    if not pairs:
        return None
    settled, ways = zip(*(_of_pair(likelihood, pair, known) for pair in pairs), strict=True)
    whole = [one + way for one, way in zip(settled, ways, strict=True)]
    log_evidence = np.stack([one.sum(axis=1) for one in whole], axis=1)
    best = np.argmax(log_evidence, axis=1)
    none = np.zeros(likelihood.outcomes.log_weight.shape[1:])
    return MarginalLikelihood(
        log_evidence=log_sum(log_evidence, axis=1) - np.log(len(pairs)),
        by_movement=lambda run: whole[best[run]][run],
        settled=lambda run: settled[best[run]][run],
        estimate=lambda run: Estimate(None, None, none),
    )


def way_of_two(likelihood: RunLikelihood, pair: tuple[int, int]) -> FloatArray:
    """Return log densities of the way with two motors off, (run, movement)."""
    if likelihood.transients is None:
        return likelihood.log_transient
    return _of_pair(likelihood, (min(pair), max(pair)))[1]


def _of_pair(
    likelihood: RunLikelihood, pair: tuple[int, int], known: Sequence[Hypothesis] = ()
) -> tuple[FloatArray, FloatArray]:
    """Return log densities of settled positions and of the way, (run, movement) each."""
    seen = two_joint_likelihood(likelihood.evidence, likelihood.model, likelihood.outcomes, pair)
    offsets, outlier = _offsets(likelihood, seen), likelihood.model.outlier_log_density
    path = PathFilter(seen, offsets, likelihood.usable, outlier).map_path()
    log_chance = np.where(_among(known, likelihood, pair), -np.inf, LOG_CHANCE)
    total = path.log_density.sum(axis=-1) + log_chance  # (run, kind)
    best = np.arange(len(total)), np.argmax(total, axis=1)
    settled = path.log_density[best]
    # What chance and the other kinds add belongs to no movement more than to another.
    more = log_sum(total, axis=1) - settled.sum(axis=1)
    count = np.maximum(likelihood.usable.sum(axis=1), 1)
    settled = settled + np.where(likelihood.usable, (more / count)[:, None], 0.0)
    if likelihood.transients is None:
        return settled, np.zeros_like(settled)
    return settled, _on_way(likelihood, seen, path.way[best], path.angle[best])


def _offsets(likelihood: RunLikelihood, seen: TwoJointLikelihood) -> LinearOffsets:
    """Return where two motors may stand, for each of `KINDS`."""
    pair = list(seen.pair)
    ends = likelihood.model.twin.robot.travel[pair]
    middle, length = ends.mean(axis=1), ends[:, 1] - ends[:, 0]
    target = np.nan_to_num(likelihood.evidence.movements.target[..., pair])
    scatter = likelihood.model.scatter[pair] ** 2
    gives = likelihood.model.held_scatter[pair] ** 2
    held, by_angle, redrawn, amount = (
        np.array([[bool(getattr(kind, name)) for kind in kinds] for kinds in KINDS])
        for name in ("held", "by_angle", "redrawn", "amount")
    )
    spread = np.array([[kind.spread for kind in kinds] for kinds in KINDS])
    slope = np.where(by_angle, target[:, :, None], 1.0)
    deviation = np.where(amount, spread * np.where(held, length, 1.0), 1.0)
    return LinearOffsets(
        centre=np.where(held, 0.0, seen.expected[:, :, None]),
        slope=np.where(amount, slope, 0.0),
        noise=np.where(held, gives, scatter) + np.where(redrawn, spread**2, 0.0),
        mean=np.where(held, middle, 0.0),
        variance=deviation**2,
        well=seen.expected,
        well_noise=scatter,
    )


def _among(
    known: Sequence[Hypothesis], likelihood: RunLikelihood, pair: tuple[int, int]
) -> BoolArray:
    """Return which of `KINDS` of two motors are known hypotheses, (kind,)."""
    names = [likelihood.model.twin.robot.motor_names[motor] for motor in pair]
    said = [{fault.motor: OFFSET_KINDS.get(fault.mode) for fault in h.faults} for h in known]
    kinds = [tuple(one[name] for name in names) for one in said if set(one) == set(names)]
    return np.array([kind in kinds for kind in KINDS])


def _on_way(
    likelihood: RunLikelihood, seen: TwoJointLikelihood, way: IntArray, angle: FloatArray
) -> FloatArray:
    """Return log densities of the way if the two motors went where they were seen to settle.

    Args:
        likelihood: The runs.
        seen: What each movement says of the two angles.
        way: Which of its ways each movement took, (run, movement); -1: none.
        angle: Where the motors stand then, (run, movement, motor) [rad].
    """
    transients = likelihood.transients
    assert transients is not None
    taken = np.maximum(way, 0)
    at = np.take_along_axis(seen.angle, taken[..., None, None], axis=2)[:, :, 0]
    ends = transients.findings.expected
    ends[..., list(seen.pair)] = np.where((way >= 0)[..., None], at, angle)[:, :, None]
    outcome = np.where(way >= 0, seen.outcome[taken], 0)
    return transients.toward(ends, outcome, seen.pair[0])


# The unknown: the best of all that is not known.

SCATTER_FACTORS = (3.0, 8.0, 25.0)
"""Factors on the scatter: just more than tails allow, to anywhere near."""
TRANSIENT_SCATTER_FACTOR = 8.0
"""The same where the motors settle as they should, but get there in another way."""
SCATTER_ODDS = 0.5
"""Odds, against healthy, of far more scatter, in any of these ways."""
OFF_ODDS = 1.0
"""The same of one motor or two being off anyhow."""
LEFT_OUT = 0.5
"""Factor on the odds of a fault that the set leaves out. All three were chosen on simulated runs,
for no more than 2 % of the known runs lost (docs/accuracy.md)."""


def unknown_likelihood(
    likelihood: RunLikelihood,
    healthy: Callable[[RunLikelihood], MarginalLikelihood],
    unlisted: Sequence[tuple[float, MarginalLikelihood]],
    known: Sequence[Hypothesis],
) -> MarginalLikelihood:
    """Return what the runs say of a fault that is not among the known ones, times its odds.

    Args:
        likelihood: The runs.
        healthy: What weighs a healthy robot.
        unlisted: Faults that are not among the known ones: their odds against healthy, and what
            the runs say of them.
        known: The known hypotheses; two motors that are off as one of them says are no unknown.
    """
    found = [(LEFT_OUT * odds, weight) for odds, weight in unlisted]
    inflated = _inflated(likelihood)
    found += [(SCATTER_ODDS / len(inflated), healthy(other)) for other in inflated]
    anyhow = unmodelled_offsets_likelihood(likelihood, known)
    if anyhow is not None:
        found.append((OFF_ODDS, anyhow))
    return _max_evidence([weight for _, weight in found], np.log([odds for odds, _ in found]))


def _inflated(likelihood: RunLikelihood) -> list[RunLikelihood]:
    """Return the runs as they look to who expects far more scatter, settled or moving."""
    inflated = [
        replace(likelihood, model=replace(likelihood.model, scatter_factor=scatter_factor))
        for scatter_factor in SCATTER_FACTORS
    ]
    if likelihood.moving is not None:
        inflated.append(
            replace(
                likelihood,
                transient_scatter_factor=TRANSIENT_SCATTER_FACTOR,
                remembered=likelihood.findings,
            )
        )
    return inflated


def _max_evidence(
    weights: Sequence[MarginalLikelihood], log_prior: FloatArray
) -> MarginalLikelihood:
    """Return what the runs say of the best explanation of each, without a size."""
    joint = np.stack([weight.log_evidence for weight in weights], axis=1) + log_prior
    best = np.argmax(joint, axis=1)

    def estimate(run: int) -> Estimate:
        return replace(weights[best[run]].estimate(run), size=None)

    return MarginalLikelihood(
        log_evidence=joint[np.arange(len(best)), best],
        by_movement=lambda run: weights[best[run]].by_movement(run),
        settled=lambda run: weights[best[run]].settled(run),
        estimate=estimate,
    )
