"""Every hypothesis weighed by runs whose theta is a mixture of normal distributions.

Hypotheses with rows go through the engine. The others (faults of the way, of two motors, or
unknown ones) and readings on the way are weighed at the most probable theta of each run:

    log p(run | h) = log p(run | h*) + log p(run | theta*, h) - log p(run | theta*, h*)

with h* the most probable hypothesis with rows and theta* its mean.

Section: docs/inference.md#runs
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.engine.healthy_rows import changes
from failuretwin.inference.engine.moments import LOSSY, Moments, moments_of
from failuretwin.inference.engine.posterior import (
    marginal_likelihoods as engine_likelihoods,
)
from failuretwin.inference.engine.posterior import most_probable_theta, theta_posterior
from failuretwin.inference.engine.rows import Scene
from failuretwin.inference.engine.runs import RunsEvidence, has_rows
from failuretwin.inference.engine.theta import Components, Layout
from failuretwin.inference.faults.marginal import MarginalLikelihood
from failuretwin.inference.faults.prior_odds import log_prior
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import TransientSamples
from failuretwin.inference.observation.registered import (
    REGISTRATION,
    registered,
    registered_evidence,
    registered_samples,
)
from failuretwin.inference.posterior import Posterior, marginal_likelihoods
from failuretwin.inference.set_ups.set_ups import odd_zero
from failuretwin.inference.set_ups.wrong_setup import ELSEWHERE

TOLD = 0.9
"""Probability from which a run says what it had to assume of its robot."""
SURE = 0.95
"""Probability of a displaced sensor from which it is told."""
ROUGHLY = 1e-3
"""Probability of a pick from which it counts where zeros are told to be odd."""
ALLOWED_FOR = "; allowed for"
"""Said where verdicts count with it."""


@dataclass(frozen=True)
class Weighing:
    """Some runs, and what is believed of their theta.

    Attributes:
        likelihood: The runs as they were seen.
        hypotheses: What may be the case; one of them has rows.
        priors: Beliefs about faults and set-ups.
        layout: Places in theta.
        components: What is believed of theta, beside the place of each run.
        place: Registration about which each run is expanded, (run, 7).
        asked: Hypotheses with rows that are weighed, (run, hypothesis); None: all.
        spread: V by which rows are centred, (theta, theta); None: that of the first component.
        known: What the runs say of the hypotheses with rows, where that was found before.
        lag_s: Lags of the motors about which runs on the way are expanded, (motor,) [s]; None: 0.
    """

    likelihood: RunLikelihood
    hypotheses: Sequence[Hypothesis]
    priors: Priors
    layout: Layout
    components: Components
    place: FloatArray
    asked: BoolArray | None = None
    spread: FloatArray | None = None
    known: RunsEvidence | None = None
    lag_s: FloatArray | None = None

    def seen_moving(self, moving: TransientSamples) -> Weighing:
        """Return the same runs with readings on the way beside where they rest."""
        likelihood = replace(self.likelihood, moving=moving)
        return replace(self, likelihood=likelihood, known=self.evidence)

    def reweighted(self, log_weight: FloatArray) -> Weighing:
        """Return the same runs by components of other weights, (run, component)."""
        known = self.evidence.reweighted(log_weight)
        return replace(self, components=known.components, known=known)

    @cached_property
    def log_odds(self) -> FloatArray:
        """Log prior of each hypothesis, (hypothesis,)."""
        return log_prior(self.hypotheses, self.priors)

    @cached_property
    def with_rows(self) -> IntArray:
        """Hypotheses with rows."""
        told = self.layout.moving, bool(self.curved.any())
        return np.flatnonzero([has_rows(h, *told) for h in self.hypotheses])

    @cached_property
    def moments(self) -> Moments:
        """The moments."""
        if self.known is not None:
            return self.known.scene.moments
        model = self.likelihood.model
        seen = registered_evidence(self.likelihood.evidence, self.place, model.sensors)
        moments = moments_of(model, seen)
        return moments if self.lag_s is None else moments.trailing(self.lag_s)

    @cached_property
    def curved(self) -> BoolArray:
        """Which runs follow curves, (run,)."""
        return np.asarray(self.moments.on_curves.any(axis=1))

    @cached_property
    def evidence(self) -> RunsEvidence:
        """What the runs say of the hypotheses with rows."""
        if self.known is not None:
            return self.known
        scene = Scene.of(
            self.likelihood.model.without_doubt,
            self.moments,
            self.priors,
            self.layout,
            self.components.usual if self.spread is None else self.spread,
        )
        hypotheses = [self.hypotheses[i] for i in self.with_rows]
        odds = self.log_odds[self.with_rows]
        return RunsEvidence(scene, hypotheses, self.components, odds, self._asked)

    @property
    def _asked(self) -> BoolArray | None:
        """Which hypotheses with rows are weighed, (run, hypothesis); None: all.

        One at least that node sums know too: the most probable theta is that of the best of these.
        """
        missed = np.isin(self.with_rows, self._missing)
        if self.asked is None and not missed.any():
            return None
        every = np.ones((len(self.curved), len(self.hypotheses)), dtype=bool)
        asked = (every if self.asked is None else self.asked)[:, self.with_rows]
        asked[:, missed] &= self.curved[:, None]
        nothing = ~asked[:, self._summed_too].any(axis=1)
        asked[nothing] |= self._summed_too
        return np.asarray(asked)

    @cached_property
    def _summed_too(self) -> BoolArray:
        """Which hypotheses with rows node sums know too, (hypothesis,)."""
        return np.array([has_rows(self.hypotheses[i]) for i in self.with_rows])

    @cached_property
    def best(self) -> tuple[IntArray, FloatArray]:
        """The most probable hypothesis of each run that node sums know too, and its mean of theta.

        They do not know what late and slow motors do on the way.
        """
        return most_probable_theta(self.evidence, self._summed_too)

    @cached_property
    def at_best(self) -> RunLikelihood:
        """The runs as a robot and a sensor would have shown them whose theta is 0."""
        _, theta = self.best
        if self.lag_s is not None:
            theta = theta.copy()
            theta[:, self.layout.lags] += self.lag_s
        likelihood, scene = self.likelihood, self.evidence.scene
        model, way = likelihood.model, likelihood.moving
        offset = np.einsum("rmct,rt->rmc", scene.columns[:, :, 0], theta)
        seen = registered_evidence(likelihood.evidence, self.place, model.sensors)
        seen = replace(seen, point=seen.point - offset)
        if way is not None:
            way = registered_samples(way, self.place + theta[:, :REGISTRATION], model.sensors)
        return RunLikelihood(seen, model.without_doubt, way)

    @cached_property
    def summed(self) -> IntArray:
        """Runs that node sums weigh too: all, or those on whose way readings count."""
        way, runs = self.likelihood.moving, np.arange(len(self.likelihood.usable))
        if self._by_sums:
            return runs
        return runs[:0] if way is None else np.flatnonzero(way.seen.any(axis=(1, 2)))

    @cached_property
    def _summed_at_best(self) -> RunLikelihood:
        """The runs that node sums weigh too, at the most probable theta."""
        return replace(self.at_best[self.summed], part_of=None)

    @cached_property
    def _settled_at_best(self) -> list[MarginalLikelihood]:
        """Settled positions of these runs, by hypothesis."""
        whole = self._summed_at_best
        settled = replace(whole, moving=None, remembered=whole.findings)
        return marginal_likelihoods(settled, self.hypotheses, self.priors)

    @cached_property
    def _whole_at_best(self) -> list[MarginalLikelihood]:
        """All readings of these runs, by hypothesis."""
        if self.likelihood.moving is None:
            return self._settled_at_best
        return marginal_likelihoods(self._summed_at_best, self.hypotheses, self.priors)

    @cached_property
    def log_evidence(self) -> FloatArray:
        """Log of weight times evidence, (run, component, hypothesis)."""
        if self.likelihood.moving is None or not len(self.summed):
            return self._log_settled
        settled, whole = (
            np.stack([one.log_evidence for one in says], axis=1)
            for says in (self._settled_at_best, self._whole_at_best)
        )
        found = self._log_settled.copy()
        found[self.summed] += (whole - settled)[:, None]
        return found

    @cached_property
    def _log_settled(self) -> FloatArray:
        """The same by settled positions alone."""
        found = self.evidence.log_evidence
        if not self._by_sums:
            return found
        settled = np.stack([one.log_evidence for one in self._settled_at_best], axis=1)
        rows, (best, _) = np.arange(len(found)), self.best
        more = settled - settled[rows, self.with_rows[best], None]
        more[:, self._missing] -= np.log1p(-self.components.lossy) - np.log1p(
            -self.evidence.lossy[rows, best, None]
        )
        table = found[rows, :, best][..., None] + more[:, None]
        for i, h in enumerate(self.with_rows.tolist()):
            told = self.curved if h in self._missing else np.ones_like(self.curved)
            table[told, :, h] = found[told, :, i]
        for h, one in self._as_on_curves.items():
            table[self.curved, :, h] = table[self.curved, :, one]
        return np.asarray(table)

    @cached_property
    def _by_sums(self) -> bool:
        """Whether some hypotheses are weighed by node sums, in some runs at least."""
        alone = len(self.with_rows) - np.isin(self.with_rows, self._missing).sum()
        return bool(alone < len(self.hypotheses))

    @property
    def _as_on_curves(self) -> dict[int, int]:
        """Hypotheses that look like another on curves, which are one movement: a healthy motor."""
        healthy = [h for h, one in enumerate(self.hypotheses) if one.is_healthy]
        missing = [h for h in self._missing.tolist() if h not in self.with_rows]
        return {h: one for h in missing for one in healthy}

    @cached_property
    def _missing(self) -> IntArray:
        """Hypotheses that a motor misses commands: they need no robot that loses more of them."""
        modes = [[MODES[fault.mode] for fault in h.faults] for h in self.hypotheses]
        return np.flatnonzero([any(m.signature is Signature.MISSED for m in ms) for ms in modes])

    @property
    def log_joint_at_rest(self) -> FloatArray:
        """Log p(h) p(run | h) by settled positions alone, (run, hypothesis)."""
        return np.asarray(log_sum(self._log_settled, axis=1) + self.log_odds)

    @property
    def by_hypothesis(self) -> FloatArray:
        """Log p(run | h), (run, hypothesis)."""
        return log_sum(self.log_evidence, axis=1)

    @property
    def total(self) -> FloatArray:
        """Log p(run) over the hypotheses with rows, (run,)."""
        return log_sum(self.evidence.by_hypothesis + self.evidence.log_odds, axis=1)

    def weights(self) -> list[MarginalLikelihood]:
        """Return what the runs say of each hypothesis, with onset and size."""
        total = self.by_hypothesis
        says = engine_likelihoods(self.evidence)
        found = dict(zip(self.with_rows.tolist(), says, strict=True))
        weighed = [self._with_way(h, found.get(h)) for h in range(len(self.hypotheses))]
        for h, one in self._as_on_curves.items():
            weighed[h] = weighed[h].shown_by(weighed[one], self.curved)
        return [replace(one, log_evidence=total[:, h]) for h, one in enumerate(weighed)]

    def _with_way(self, h: int, settled: MarginalLikelihood | None) -> MarginalLikelihood:
        """Return what runs say of a hypothesis, those on whose way it counts by all readings.

        Of a motor that sticks now and then the engine tells on curves alone.
        """
        way, summed = self.likelihood.moving, self.summed
        if settled is None:
            return self._whole_at_best[h]
        whole = np.zeros(len(self.curved), dtype=bool)
        if way is not None:
            whole[summed] = way.seen[summed].any(axis=(1, 2))
        if h in self._missing:
            whole = ~self.curved
        if not whole.any():
            return settled
        said = [(settled, run) for run in range(len(whole))]
        for at, run in enumerate(summed.tolist()):
            if whole[run]:
                said[run] = self._whole_at_best[h], at
        return MarginalLikelihood(
            settled.log_evidence,
            lambda run: said[run][0].by_movement(said[run][1]),
            lambda run: said[run][0].settled(said[run][1]),
            lambda run: said[run][0].estimate(said[run][1]),
        )

    def posterior(self) -> Posterior:
        """Return the posterior over hypotheses."""
        log_joint = self.by_hypothesis + self.log_odds
        return Posterior(
            self.likelihood,
            self.hypotheses,
            self.log_odds,
            log_joint - log_sum(log_joint, axis=1)[:, None],
            self.weights(),
            self.remarks,
            self.odd_zeros,
            log_settled=log_sum(self.log_joint_at_rest, axis=1),
        )

    @cached_property
    def share(self) -> FloatArray:
        """Probability of each component and hypothesis, (run, component, hypothesis)."""
        height = self.log_evidence + self.log_odds
        return np.exp(height - log_sum(height, axis=(1, 2))[:, None, None])

    @cached_property
    def lossy(self) -> FloatArray:
        """Probability that the robot of each run loses more commands, (run,)."""
        height = self.evidence.by_hypothesis + self.evidence.log_odds
        share = np.exp(height - log_sum(height, axis=1)[:, None])
        return np.sum(share * self.evidence.lossy, axis=1)

    @property
    def remarks(self) -> list[str]:
        """What each run had to assume of its robot and its sensor; empty where nothing."""
        share = self.share.sum(axis=2)
        return [self._remark(run, one) for run, one in enumerate(share)]

    def _remark(self, run: int, share: FloatArray) -> str:
        components = self.components
        wide = components.sigma > 1.0
        noisy = components.noise_m > 1.5 * self.likelihood.model.path_noise
        said = []
        if share[components.displaced].sum() > SURE:
            said.append(
                f"{ELSEWHERE} "
                f"({share[components.displaced].sum():.1%}): the tool appears about "
                f"{self._distance_mm(run):.2g} mm off{ALLOWED_FOR}. `failuretwin robot fit` on "
                "healthy runs finds its frame"
            )
        if share[wide].sum() > TOLD:
            factor = components.sigma[int(np.argmax(np.where(wide, share, 0.0)))]
            known = self.likelihood.model.imperfections
            usual = "arms of this class do" if known.of_class else "when they were calibrated"
            said.append(
                f"the motors seem to scatter about {factor:g} times as much as {usual}; judged so"
            )
        if share[noisy].sum() > TOLD:
            noise = 1e3 * components.noise_m[int(np.argmax(np.where(noisy, share, 0.0)))]
            said.append(
                f"the sensor seems noisier than is known of it: by about {noise:.2g} mm; judged so"
            )
        if self.lossy[run] > TOLD:
            said.append(
                f"commands seem to get lost about {LOSSY:g} times as often as with such arms; "
                "judged so"
            )
        if self._loaded[run]:
            said.append(self._loaded[run])
        return "; ".join(said)

    @cached_property
    def _loaded(self) -> list[str]:
        """What each run says of a load that the tool picked up or set down; empty: nothing."""
        evidence = self.evidence
        said = [""] * evidence.scene.moments.runs
        whole = log_sum(evidence.by_hypothesis + evidence.log_odds, axis=1)
        for h in np.flatnonzero([one.is_healthy for one in evidence.hypotheses]).tolist():
            one = evidence.weighed[h]
            share = np.exp(evidence.height(h) - whole[one.picks.run]) * (one.picks.row > 0)
            total = np.bincount(one.picks.run, share, len(said))
            for run in np.flatnonzero(total > TOLD).tolist():
                best = int(np.argmax(np.where(one.picks.run == run, share, -1.0)))
                loaded = changes(evidence.scene.moments.count)[one.picks.row[best]]
                at = evidence.scene.moments.start[run, int(np.flatnonzero(np.diff(loaded))[0]) + 1]
                when = f"until about {at:.1f} s" if loaded[0] else f"from about {at:.1f} s on"
                mass = one.amount[best, 0]
                said[run] = f"the tool seems to carry about {mass:.2g} kg {when}; judged so"
        return said

    def _distance_mm(self, run: int) -> float:
        """Return how far the sensor's frame moves the tool of a run in the mean [mm]."""
        theta = self.place[run] + self.best[1][run, :REGISTRATION]
        evidence = self.likelihood.evidence
        seen = evidence.point[run][evidence.usable[run]]
        away = registered(seen[None], theta[None])[0] - seen
        return 1e3 * float(np.linalg.norm(away, axis=1).mean())

    @property
    def odd_zeros(self) -> list[str]:
        """Which zero of each run is far off what such robots do; empty where none is."""
        usual = self.components.usual_deviation
        return odd_zeros_of(self, usual, np.zeros(self.layout.size))


def odd_zeros_of(weighing: Weighing, usual: FloatArray, given: FloatArray) -> list[str]:
    """Return which zero of each run is far off what such robots do; empty where none is.

    Args:
        weighing: The runs.
        usual: Deviation of theta among such robots, (theta,).
        given: Theta about which the runs are expanded, (theta,).
    """
    motors = weighing.layout.motors
    zeros = slice(REGISTRATION, REGISTRATION + motors)
    mean, covariance = theta_posterior(weighing.evidence, ROUGHLY)
    deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))[:, zeros]
    off = mean[:, zeros] + given[zeros]
    sure = np.maximum(np.abs(off) - 2.0 * deviation, 0.0) / usual[zeros]
    robot = weighing.likelihood.model.twin.robot
    return [odd_zero(robot, *pair) for pair in zip(off, sure, strict=True)]


def assembled(
    likelihood: RunLikelihood, parts: Sequence[Posterior], part: IntArray, row: IntArray
) -> Posterior:
    """Return the posterior of runs that were weighed in parts.

    Args:
        likelihood: All runs.
        parts: Posteriors of some of them.
        part: Which holds each run, (run,).
        row: Its place there, (run,).
    """
    first = parts[0]
    places = list(zip(part.tolist(), row.tolist(), strict=True))

    def weight(h: int) -> MarginalLikelihood:
        def of(run: int) -> tuple[MarginalLikelihood, int]:
            p, r = places[run]
            return parts[p].weights[h], r

        return MarginalLikelihood(
            np.array([parts[p].weights[h].log_evidence[r] for p, r in places]),
            lambda run: of(run)[0].by_movement(of(run)[1]),
            lambda run: of(run)[0].settled(of(run)[1]),
            lambda run: of(run)[0].estimate(of(run)[1]),
        )

    return Posterior(
        likelihood,
        first.hypotheses,
        first.log_prior,
        np.stack([parts[p].log_posterior[r] for p, r in places]),
        [weight(h) for h in range(len(first.hypotheses))],
        [parts[p].set_up[r] if parts[p].set_up else "" for p, r in places],
        [parts[p].offsets[r] if parts[p].offsets else "" for p, r in places],
        unasked=[parts[p].unasked[r] if parts[p].unasked else "" for p, r in places],
        log_settled=np.array([parts[p].settled_evidence[r] for p, r in places]),
    )
