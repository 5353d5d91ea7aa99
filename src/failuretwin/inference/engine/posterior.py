"""What is left of onset, size and theta once every row is weighed.

    p(row, c | run, h) ~ w_c p(row | h) p(run | row, c)
    theta | run, row, c: mu + V G^T a,    V - V G^T (I + W K)^-1 W G V
    a = (I + W K)^-1 (b - W G mu)

Section: docs/inference.md#runs
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.numerics import Weighted, log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.engine.filter import RowsPosterior
from failuretwin.inference.engine.moments import Moments
from failuretwin.inference.engine.picks import Part, Picks
from failuretwin.inference.engine.rows import Drawn
from failuretwin.inference.engine.runs import RunsEvidence, Weighed
from failuretwin.inference.faults.marginal import Estimate, MarginalLikelihood
from failuretwin.inference.posterior import is_held

LEAST_SHARE = 1e-4
"""Picks of a run that are less probable add nothing to what is left of theta and of sizes."""
LEAST_OUTLIER = 1e-15
"""Smallest share of the outlier: the density of a moment is told by it."""
NORMAL_STEPS = np.linspace(-3.6, 3.6, 25)
"""Nodes of a normal distribution, in deviations, and their weights."""
NORMAL_WEIGHTS = np.exp(-0.5 * NORMAL_STEPS**2)


def marginal_likelihoods(evidence: RunsEvidence) -> list[MarginalLikelihood]:
    """Return what the runs say of each hypothesis, with onset and size."""
    by_hypothesis = evidence.by_hypothesis
    return [_marginal(evidence, h, by_hypothesis[:, h]) for h in range(len(evidence.hypotheses))]


def _marginal(evidence: RunsEvidence, h: int, log_evidence: FloatArray) -> MarginalLikelihood:
    def picked(run: int) -> tuple[IntArray, FloatArray]:
        return _shares(evidence, evidence.weighed[h], run)

    def by_movement(run: int) -> FloatArray:
        some, share = picked(run)
        return _one_by_one(evidence.weighed[h], some, share)

    def settled(run: int) -> FloatArray:
        some, share = picked(run)
        return _given_all(evidence, h, int(some[share.argmax()]))

    def estimate(run: int) -> Estimate:
        some, share = picked(run)
        best = some[share.argmax()]
        outcomes = _outcome_probability(evidence, h, best)
        return Estimate(_onset(evidence, h, some, share), _size(evidence, h, some, share), outcomes)

    return MarginalLikelihood(log_evidence, by_movement, settled, estimate)


def _shares(evidence: RunsEvidence, one: Weighed, run: int) -> tuple[IntArray, FloatArray]:
    """Return the picks of a run and how probable each is under its hypothesis."""
    some = np.flatnonzero(one.picks.run == run)
    component = one.picks.component[some]
    says = one.log_evidence[some] + evidence.components.weight(one.picks.run[some], component)
    return some, np.exp(says - log_sum(says, axis=0))


def _one_by_one(one: Weighed, some: IntArray, share: FloatArray) -> FloatArray:
    """Return the log density of each moment given those before it, (moment,)."""
    log_density = one.found.log_evidence[some]
    with np.errstate(divide="ignore"):
        start = np.log(share) - log_density.sum(axis=1)
    so_far = start[:, None] + np.cumsum(log_density, axis=1)
    return np.diff(log_sum(so_far, axis=0), prepend=log_sum(start, axis=0))


def _given_all(evidence: RunsEvidence, h: int, pick: int) -> FloatArray:
    """Return the log density of each moment given all others, by its outlier's share, (moment,)."""
    share = evidence.weighed[h].found.share[pick]
    outlier = np.maximum(1.0 - share.sum(axis=-1), LEAST_OUTLIER)
    usable = evidence.scene.moments.usable[evidence.weighed[h].picks.run[pick]]
    return np.where(usable, evidence.scene.noise.log_outlier - np.log(outlier), 0.0)


def _onset(evidence: RunsEvidence, h: int, some: IntArray, share: FloatArray) -> Weighted | None:
    rows, one = evidence.rows[h], evidence.weighed[h]
    if rows.onsets is None:
        return None
    if rows.episodes is not None:
        of_run = int(one.picks.run[some[0]])
        first = _of_episodes(evidence, h, some, share).sum(axis=1)
        onset, part = rows.episodes.onset[of_run], rows.episodes.part[of_run]
        return Weighted(onset.ravel(), (first[:, None] * part).ravel())
    run, row = one.picks.run[some].tolist(), one.picks.row[some].tolist()
    told = zip(run, row, one.amount[some], strict=True)
    parts = [rows.onsets(*one) for one in told]
    weights = [
        p * part / max(part.sum(), 1e-300) for p, (_, part) in zip(share, parts, strict=True)
    ]
    return Weighted(np.concatenate([onset for onset, _ in parts]), np.concatenate(weights))


def _size(evidence: RunsEvidence, h: int, some: IntArray, share: FloatArray) -> Weighted | None:
    rows = evidence.rows[h]
    if rows.episodes is not None:
        return Weighted(rows.episodes.sizes, _of_episodes(evidence, h, some, share).sum(axis=0))
    if rows.drawn is not None:
        some, share = some[share > LEAST_SHARE], share[share > LEAST_SHARE]
        mean, deviation = _mean_squares(evidence, h, some)
        picks = evidence.weighed[h].picks[some]
        constant = rows.variance[picks.run, picks.row] > 0.0
        size, spread = _amounts(evidence, h, some[constant]).T
        mean[constant], deviation[constant] = size**2 + spread**2, 2.0 * np.abs(size) * spread
    elif rows.amount_prior is not None:
        mean, deviation = _amounts(evidence, h, some).T
        if is_held(evidence.hypotheses[h]):
            deviation = np.hypot(deviation, evidence.scene.model.count_rounding)
    else:
        return None
    values = mean[:, None] + deviation[:, None] * NORMAL_STEPS
    weights = share[:, None] * NORMAL_WEIGHTS
    if rows.drawn is not None:  # the mean square is nearly normal, not its root
        values = np.sqrt(np.maximum(values, 0.0))
    return Weighted(values.ravel(), weights.ravel())


def _of_episodes(evidence: RunsEvidence, h: int, some: IntArray, share: FloatArray) -> FloatArray:
    """Return the first moment that sticks and the share of time of a run, (moment, size)."""
    rows, one = evidence.rows[h], evidence.weighed[h]
    assert rows.episodes is not None
    picks, found = one.picks[some], one.found.share[some]
    usable = evidence.scene.moments.usable[picks.run]
    told = rows.episodes.told(evidence.part(h, picks).kept, np.where(usable[..., None], found, 0.0))
    parts = [
        rows.episodes.posterior(run, row, int(rows.first[row]), (p, q))
        for run, row, p, q in zip(picks.run.tolist(), picks.row.tolist(), *told, strict=True)
    ]
    return np.einsum("p,pms->ms", share, np.stack(parts))


def _amounts(evidence: RunsEvidence, h: int, some: IntArray) -> FloatArray:
    """Return mean and deviation of the amount of some picks, with what theta adds, (pick, 2)."""
    rows, one = evidence.rows[h], evidence.weighed[h]
    told = one.amount[some]
    if rows.tie is None:
        return told
    picks = one.picks[some]
    tie = rows.tie[picks.run, picks.row]
    tied = np.flatnonzero(tie.any(axis=-1))
    if not len(tied):
        return told
    some, picks, tie = some[tied], picks[tied], tie[tied]
    part, variance = evidence.part(h, picks), rows.variance[picks.run, picks.row]
    V, mu = part.components.theta(picks.run, part.normal)
    pull = np.einsum("pt,ptu->pu", tie, V)
    lever = rows.lever[picks.run, picks.row]
    across = np.einsum("pmct,pt->pmc", part.columns, pull) + variance[:, None, None] * lever
    across = across.reshape(len(tied), 1, -1)
    more, less = _given(part, *one.found.some(some).sites, across)
    prior = variance + np.sum(pull * tie, axis=-1)
    left = np.maximum(prior - less[:, 0, 0], 0.0)
    mean = rows.centre[picks.run, picks.row] + np.sum(tie * mu, axis=-1) + more[:, 0]
    found = told.copy()
    found[tied] = np.stack([mean, np.sqrt(left)], axis=-1)
    return found


def _mean_squares(evidence: RunsEvidence, h: int, some: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and deviation of the mean square of sizes that movements draw anew, (pick,).

    What theta leaves open is shared by the moments. Movements that are not seen have the size that
    is expected beforehand.
    """
    rows, one, moments = evidence.rows[h], evidence.weighed[h], evidence.scene.moments
    assert rows.drawn is not None
    picks, found = one.picks[some], one.found.some(some)
    part, run = evidence.part(h, picks), picks.run
    after = np.arange(moments.count) >= rows.first[picks.row][:, None]
    sized = np.where(np.isfinite(rows.drawn.size[part.kept]), found.share, 0.0)
    seen = after & moments.usable[run] & (sized.sum(axis=-1) > 0.0)
    powers, across = _sizes(rows.drawn, part, found, sized)
    middle, square, fourth = np.where(seen, powers, 0.0)
    _, theta = theta_given(part, *found.sites)
    moved = np.einsum("pmc,pmct->pmt", np.where(seen[..., None], across, 0.0), part.columns)
    shared = moved @ theta @ np.swapaxes(moved, -1, -2)
    mean, spread = rows.drawn.square[picks.row].T
    hidden = np.array([_hidden(moments, *told) for told in zip(run, after, seen, strict=True)])
    total = np.sum(square, axis=1) + np.trace(shared, axis1=1, axis2=2) + hidden * mean
    variance = np.sum(np.maximum(fourth - square**2, 0.0), axis=1) + hidden * spread
    variance += 4.0 * np.einsum("pm,pmn,pn->p", middle, shared, middle)
    count = np.maximum(seen.sum(axis=1) + hidden, 1)
    return total / count, np.sqrt(variance) / count


def _hidden(moments: Moments, run: int, after: BoolArray, seen: BoolArray) -> int:
    """Return how many movements of a run are affected but not seen."""
    start, exists = moments.start[run], moments.ramp[run].any(axis=1)
    return len(np.unique(start[exists & after & ~np.isin(start, start[seen])]))


def _sizes(
    drawn: Drawn, part: Part, found: RowsPosterior, sized: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return means of x, x^2 and x^4 (3, pick, moment) of sizes x, and dx/df (..., channel).

    In the node s of width w with lever J, residual r and scale S, which holds w^2/12 J J^T,

        x | node ~ N(s + k J^T S^-1 r, k - k^2 J^T S^-1 J),    k = w^2 / 12

    Args:
        drawn: The nodes.
        part: The picks.
        found: What moments say.
        sized: Share of the outcomes that have a size, (pick, moment, outcome).
    """
    powers, across = np.zeros((3, *sized.shape[:2])), np.zeros_like(found.mean)
    share = sized / np.maximum(sized.sum(axis=-1, keepdims=True), 1e-300)
    for m in range(sized.shape[1]):
        kept = part.kept[:, m]
        node, width = np.nan_to_num(drawn.size[kept]), drawn.width[kept]
        lever = drawn.lever[part.picks.run[:, None], m, kept]
        residual, scale = part.outcomes_at(m)
        pull = np.linalg.solve(scale, lever[..., None])[..., 0]
        known = np.sum(pull * lever, axis=-1)
        within = width**2 / 12.0
        step = within * np.sum(pull * (residual - found.mean[:, None, m]), axis=-1)
        size = node + np.clip(step, -width, width)
        left = np.maximum(within * (1.0 - within * known), 0.0)
        fourth = size**4 + 6.0 * size**2 * left + 3.0 * left**2
        for k, values in enumerate((size, size**2 + left, fourth)):
            powers[k, :, m] = np.sum(share[:, m] * values, axis=-1)
        best = np.arange(len(kept)), share[:, m].argmax(axis=-1)
        across[:, m] = pull[best] / np.maximum(known[best], 1e-12)[:, None]
    return powers, across


def _outcome_probability(evidence: RunsEvidence, h: int, pick: int) -> FloatArray:
    """Return the probability of each outcome of each movement, (movement, outcome)."""
    moments, one = evidence.scene.moments, evidence.weighed[h]
    run = one.picks.run[pick]
    usual = evidence.rows[h].usual[evidence.part(h, one.picks[pick : pick + 1]).kept[0]]
    table = np.zeros((moments.count, len(evidence.scene.model.lost_commands.lost)))
    for m in np.flatnonzero(moments.usable[run]).tolist():
        np.add.at(table[m], moments.outcome[run, m, usual[m]], one.found.share[pick, m])
    return table


@dataclass(frozen=True)
class ThetaPart:
    """Theta under the picks of one hypothesis that count.

    Attributes:
        hypothesis: Its index.
        places: Indices of the picks among all of the hypothesis, (pick,).
        picks: The picks.
        weight: Their posterior probability in their run, (pick,).
        mean: (pick, theta).
        covariance: (pick, theta, theta).
    """

    hypothesis: int
    places: IntArray
    picks: Picks
    weight: FloatArray
    mean: FloatArray
    covariance: FloatArray

    def __getitem__(self, some: IntArray | BoolArray) -> ThetaPart:
        """Return some of the picks."""
        kept: IntArray = np.arange(len(self.places))[some]
        arrays = (self.weight, self.mean, self.covariance)
        rest = (array[kept] for array in arrays)
        return ThetaPart(self.hypothesis, self.places[kept], self.picks[kept], *rest)

    def of_components(self, which: BoolArray) -> ThetaPart:
        """Return the picks by some components, (component,)."""
        return self[which[self.picks.component]]

    def above(self, least: float) -> ThetaPart:
        """Return the picks that are more probable."""
        return self[self.weight > least]

    def scaled(self, factor: FloatArray) -> ThetaPart:
        """Return the same with the weights of each run multiplied, (run,)."""
        return replace(self, weight=self.weight * factor[self.picks.run])


def theta_parts(evidence: RunsEvidence, least: float = LEAST_SHARE) -> list[ThetaPart]:
    """Return theta under all picks that are more probable than `least`, by hypothesis."""
    whole = log_sum(evidence.by_hypothesis + evidence.log_odds, axis=1)
    return [_theta_of(evidence, h, whole, least) for h in range(len(evidence.hypotheses))]


def theta_posterior(
    evidence: RunsEvidence, least: float = LEAST_SHARE
) -> tuple[FloatArray, FloatArray]:
    """Return mean (run, theta) and covariance (run, theta, theta) of theta over all hypotheses.

    Args:
        evidence: The runs.
        least: Probability of a pick from which it counts.
    """
    return pooled(theta_parts(evidence, least), evidence.scene.moments.runs)


def pooled(parts: Sequence[ThetaPart], runs: int) -> tuple[FloatArray, FloatArray]:
    """Return mean (run, theta) and covariance of theta of some runs over several parts."""
    run, weight, mean, covariance = (
        np.concatenate(values)
        for values in zip(
            *((p.picks.run, p.weight, p.mean, p.covariance) for p in parts), strict=True
        )
    )
    size = mean.shape[-1]
    total, centre = np.full(runs, 1e-300), np.zeros((runs, size))
    np.add.at(total, run, weight)
    weight = weight / total[run]
    np.add.at(centre, run, weight[:, None] * mean)
    away = mean - centre[run]
    spread = np.zeros((runs, size, size))
    np.add.at(spread, run, weight[:, None, None] * (covariance + away[:, :, None] * away[:, None]))
    return centre, spread


def _theta_of(evidence: RunsEvidence, h: int, whole: FloatArray, least: float) -> ThetaPart:
    one = evidence.weighed[h]
    weight = np.exp(evidence.height(h) - whole[one.picks.run])
    return theta_of_picks(evidence, h, np.flatnonzero(weight > least), weight)


def theta_of_picks(
    evidence: RunsEvidence, h: int, places: IntArray, weight: FloatArray
) -> ThetaPart:
    """Return theta under some picks of a hypothesis.

    Args:
        evidence: The runs.
        h: Index of the hypothesis.
        places: Which of its picks.
        weight: Probability of all of its picks, (pick,).
    """
    one = evidence.weighed[h]
    picks, found = one.picks[places], one.found.some(places)
    mean, covariance = theta_given(evidence.part(h, picks), *found.sites)
    return ThetaPart(h, places, picks, weight[places], mean, covariance)


def most_probable_theta(evidence: RunsEvidence, among: BoolArray) -> tuple[IntArray, FloatArray]:
    """Return the most probable of some hypotheses for each run, (run,), and its mean of theta.

    Theta is that of its most probable row and component, (run, theta).

    Args:
        evidence: The runs.
        among: Which hypotheses, (hypothesis,).
    """
    runs, count = evidence.scene.moments.runs, len(evidence.hypotheses)
    best, place = np.full((runs, count), -np.inf), np.zeros((runs, count), dtype=np.int64)
    for h, one in enumerate(evidence.weighed):
        height = evidence.height(h)
        order = np.argsort(height, kind="stable")
        run = one.picks.run[order]
        best[run, h], place[run, h] = height[order], order
    height = np.where(among, evidence.by_hypothesis + evidence.log_odds, -np.inf)
    likely = height.argmax(axis=1)
    theta = np.zeros((runs, evidence.scene.layout.size))
    for h in np.unique(likely).tolist():
        rows = np.flatnonzero(likely == h)
        part = theta_of_picks(evidence, h, place[rows, h], np.exp(evidence.height(h)))
        theta[part.picks.run] = part.mean
    return likely, theta


def theta_factors(evidence: RunsEvidence) -> tuple[FloatArray, FloatArray]:
    """Return what each run alone says of theta as a normal factor, whatever is believed of it.

        exp(-1/2 theta^T Lambda theta + eta^T theta),    Lambda = A^T W A,    eta = A^T b

    with A = [G H], the amount integrated out, averaged over all rows by their probability.

    Returns:
        Lambda (run, theta, theta) and eta (run, theta).
    """
    runs, size = evidence.scene.moments.runs, evidence.scene.layout.size
    information, shift = np.zeros((runs, size, size)), np.zeros((runs, size))
    for part in theta_parts(evidence):
        own, pull = _factors_of(evidence, part)
        np.add.at(information, part.picks.run, part.weight[:, None, None] * own)
        np.add.at(shift, part.picks.run, part.weight[:, None] * pull)
    return information, shift


def _factors_of(evidence: RunsEvidence, part: ThetaPart) -> tuple[FloatArray, FloatArray]:
    h, picks = part.hypothesis, part.picks
    rows, found = evidence.rows[h], evidence.weighed[h].found.some(part.places)
    G = evidence.part(h, picks).columns
    lever = rows.lever[picks.run, picks.row]
    A = np.concatenate([G, lever[..., None]], axis=-1)
    W, b = found.sites
    whole = np.einsum("pmct,pmcd,pmdu->ptu", A, W, A, optimize=True)
    pull = np.einsum("pmct,pmc->pt", A, b)
    variance = rows.variance[picks.run, picks.row]
    own = whole[:, -1, -1] + 1.0 / np.maximum(variance, 1e-18)
    across = whole[:, :-1, -1]
    information = whole[:, :-1, :-1] - across[:, :, None] * across[:, None] / own[:, None, None]
    return information, pull[:, :-1] - across * (pull[:, -1] / own)[:, None]


OUTLYING = 100.0
"""Squared distance that stands for an outlier when the fit of a run is judged."""


def misfit_of(evidence: RunsEvidence) -> FloatArray:
    """Return the mean squared distance of the moments of each run in scales, (run,)."""
    total = np.zeros(evidence.scene.moments.runs)
    for part in theta_parts(evidence):
        found = evidence.weighed[part.hypothesis].found.some(part.places)
        ready = evidence.part(part.hypothesis, part.picks)
        usable = evidence.scene.moments.usable[part.picks.run]
        square = np.zeros(usable.shape)
        for m in range(usable.shape[1]):
            (residual, scale), share = ready.outcomes_at(m), found.share[:, m]
            off = residual - found.mean[:, None, m]
            pull = np.linalg.solve(scale, off[..., None])[..., 0]
            square[:, m] = np.sum(share * np.sum(off * pull, axis=-1), axis=1)
            square[:, m] += OUTLYING * (1.0 - share.sum(axis=1))
        mean = np.sum(np.where(usable, square, 0.0), axis=1) / np.maximum(usable.sum(axis=1), 1)
        np.add.at(total, part.picks.run, part.weight * mean)
    return total


def theta_given(
    part: Part, information: FloatArray, shift: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return theta of each pick given the factors of its moments: mean and covariance.

    Args:
        part: The picks.
        information: W of each moment, (pick, moment, channel, channel).
        shift: b of each moment, (pick, moment, channel).
    """
    V, mu = part.components.theta(part.picks.run, part.normal)
    picks, moments, channels = shift.shape
    GV = part.columns.reshape(picks, moments * channels, V.shape[-1]) @ V
    more, less = _given(part, information, shift, np.swapaxes(GV, -1, -2))
    return mu + more, V - less


def _given(
    part: Part, information: FloatArray, shift: FloatArray, across: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return by how much moments move the mean of something, and lessen its covariance.

    Args:
        part: The picks.
        information: W of each moment, (pick, moment, channel, channel).
        shift: b of each moment, (pick, moment, channel).
        across: Covariance with f beforehand, (pick, thing, moment * channel).

    Returns:
        (pick, thing) and (pick, thing, thing).
    """
    mean, K = part.prior
    picks, moments, channels = shift.shape
    size = moments * channels
    W = np.zeros((picks, size, size))
    for m in range(moments):
        at = slice(m * channels, (m + 1) * channels)
        W[:, at, at] = information[:, m]
    system = np.eye(size) + W @ K
    pull = shift.reshape(picks, size) - np.matmul(W, mean[..., None])[..., 0]
    alpha = np.linalg.solve(system, pull[..., None])
    seen = np.linalg.solve(system, W @ np.swapaxes(across, -1, -2))
    return np.matmul(across, alpha)[..., 0], across @ seen
