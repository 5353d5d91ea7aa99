"""The posterior over hypotheses with what is shared and unknown integrated out.

    p(run | h) = sum over c of pi_c  integral of p(run | h, theta) N(theta; 0, P_c) dtheta

over the components c of what is believed of theta: that all is as the profile and the calibration
say, and set-ups that are off by group. Integrals are Laplace's, at the best theta of each
hypothesis. Set-ups are weighed in full only where they could change a verdict; a run that nothing
explains is registered first, from coarse to fine.

Section: docs/inference.md#shared-unknowns
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.engine.registration import (
    displaced_posterior,
    robot_posterior,
)
from failuretwin.inference.engine.runs import has_rows
from failuretwin.inference.faults.marginal import MarginalLikelihood
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.posterior import (
    Posterior,
    compute_posterior,
    marginal_likelihoods,
)
from failuretwin.inference.set_ups.set_ups import odd_zero
from failuretwin.inference.theta.linear_response import LinearResponse
from failuretwin.inference.theta.shared_unknowns import REGISTRATION, layout_of, registered
from failuretwin.inference.theta.shared_weighing import Candidate, SharedWeighing

SURE = 0.95
"""Probability of a wrong set-up from which it is told."""
ALLOWED_FOR = "; allowed for"
"""Said where verdicts count with it."""


def shared_posterior(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors, in_doubt: bool
) -> Posterior:
    """Weigh every hypothesis by some runs, what they share integrated out.

    Where no hypothesis has rows, theta is taken as told; so it is where nothing of it is unknown.

    Args:
        likelihood: The runs as they were seen.
        hypotheses: What may be the case.
        priors: Beliefs about faults and set-ups.
        in_doubt: Whether their sensor may be displaced.
    """
    if not any(has_rows(h) for h in hypotheses):
        return compute_posterior(likelihood, hypotheses, priors)
    if in_doubt:
        return displaced_posterior(likelihood, hypotheses, priors)
    if layout_of(likelihood.model).offsets or likelihood.model.sensors.in_doubt:
        return robot_posterior(likelihood, hypotheses, priors)
    return compute_posterior(likelihood, hypotheses, priors)


@dataclass(frozen=True)
class Mixture:
    """What some runs say in all components.

    Attributes:
        weighing: The runs.
        candidates: What was found; the first: that the set-up is as it should be.
        log_evidence: log pi_c p(run | c, h) of each candidate, (run, candidate, hypothesis).
    """

    weighing: SharedWeighing
    candidates: Sequence[Candidate]
    log_evidence: FloatArray

    @classmethod
    def of(cls, weighing: SharedWeighing, found: Sequence[Candidate]) -> Mixture:
        """Return the mixture of what was found in some components."""
        shape = (len(weighing.nowhere), len(found), len(weighing.hypotheses))
        table = np.full(shape, -np.inf)
        for i, each in enumerate(found):
            settled = each.found.log_evidence + weighing.parts[each.component].log_weight
            table[each.rows, i] = settled
        return cls(weighing, found, table)

    @cached_property
    def winner(self) -> IntArray:
        """The candidate that says most of each hypothesis, (run, hypothesis)."""
        return np.asarray(np.argmax(self.log_evidence, axis=1))

    def posterior(self) -> Posterior:
        """Return the posterior over hypotheses."""
        weights, weighing = self.weights(), self.weighing
        log_joint = np.stack([each.log_evidence for each in weights], axis=1) + weighing.log_odds
        log_posterior = log_joint - log_sum(log_joint, axis=1)[:, None]
        return Posterior(
            weighing.likelihood,
            weighing.hypotheses,
            weighing.log_odds,
            log_posterior,
            weights,
            self.remarks(),
            self.odd_zeros(),
        )

    def weights(self) -> list[MarginalLikelihood]:
        """Return what the runs say of each hypothesis."""
        return [self._weight(h) for h in range(len(self.weighing.hypotheses))]

    def _weight(self, h: int) -> MarginalLikelihood:
        @cache
        def alone(run: int) -> MarginalLikelihood:
            return self._alone(run, h)

        return MarginalLikelihood(
            self._by_component[..., h],
            lambda run: alone(run).by_movement(0),
            lambda run: alone(run).settled(0),
            lambda run: alone(run).estimate(0),
        )

    @cached_property
    def _by_component(self) -> FloatArray:
        """Log p(run | h), each component once, by its better candidate, (run, hypothesis)."""
        components_of = np.array([each.component for each in self.candidates])
        best = [
            self.log_evidence[:, components_of == c].max(axis=1) for c in np.unique(components_of)
        ]
        return log_sum(np.stack(best, axis=1), axis=1) + self._on_the_way

    @cached_property
    def _on_the_way(self) -> FloatArray:
        """What readings on the way add to each hypothesis, (run, hypothesis).

        They are judged where the most probable hypothesis puts the sensor.
        """
        weighing, moving = self.weighing, self.weighing.likelihood.moving
        added = np.zeros((len(weighing.nowhere), len(weighing.hypotheses)))
        if moving is None or not moving.seen.any():
            return added
        flat = (self.log_evidence + weighing.log_odds).reshape(len(added), -1)
        best = np.argmax(flat, axis=1)
        candidate, hypothesis = np.divmod(best, len(weighing.hypotheses))
        for i, each in enumerate(self.candidates):
            chosen = np.flatnonzero(candidate[each.rows] == i)
            if len(chosen):
                rows = each.rows[chosen]
                theta = each.found.theta[chosen, hypothesis[rows]]
                added[rows] = self._added(each.found.expansion[chosen].response, theta)
        return added

    def _added(self, response: LinearResponse, theta: FloatArray) -> FloatArray:
        whole = response.whole_at(theta)
        says = [
            marginal_likelihoods(each, self.weighing.hypotheses, self.weighing.priors)
            for each in (whole, replace(whole, moving=None))
        ]
        return np.stack([w.log_evidence - s.log_evidence for w, s in zip(*says, strict=True)], 1)

    def _alone(self, run: int, h: int) -> MarginalLikelihood:
        """Return what one run says of one hypothesis at its best theta."""
        each = self.candidates[self.winner[run, h]]
        at = np.flatnonzero(each.rows == run)
        response = each.found.expansion[at].response
        whole = response.whole_at(each.found.theta[at, h])
        hypotheses = self.weighing.hypotheses
        asked = [hypotheses[h]] if hypotheses[h].known else hypotheses
        return marginal_likelihoods(whole, asked, self.weighing.priors)[0 if len(asked) == 1 else h]

    def odd_zeros(self) -> list[str]:
        """Return which zero of each run is far off what such robots do, empty where none is.

        By the best theta of the most probable hypothesis, less two of its deviations; a motor that
        it calls faulty has none.
        """
        layout, count = self.weighing.layout, len(self.weighing.nowhere)
        if not layout.offsets:
            return []
        zeros = slice(REGISTRATION, REGISTRATION + layout.motors)
        usual, parts = self.weighing.parts[0].deviation[zeros], self.weighing.parts
        height = self.log_evidence + self.weighing.log_odds
        first = height.reshape(count, -1).argmax(axis=1)
        told = []
        for run, (c, h) in enumerate(zip(*np.unravel_index(first, height.shape[1:]), strict=True)):
            each = self.candidates[c]
            row = int(np.flatnonzero(each.rows == run)[0])
            zero = (each.found.theta[row, h] + each.found.expansion.place[row])[zeros]
            precision = np.diag(parts[each.component].deviation ** -2.0)
            covariance = np.linalg.inv(precision + each.found.information[row, h])
            open_by = 2.0 * np.sqrt(np.diag(covariance)[zeros])
            robot = self.weighing.likelihood.model.twin.robot
            told.append(odd_zero(robot, zero, np.maximum(np.abs(zero) - open_by, 0.0) / usual))
        return told

    def remarks(self) -> list[str]:
        """Return what is to be said of the set-up of each run, empty where nothing is."""
        height = log_sum(self.log_evidence + self.weighing.log_odds, axis=2)
        share = np.exp(height - log_sum(height, axis=1)[:, None])
        return [self._remark(run, share[run]) for run in range(len(share))]

    def _remark(self, run: int, share: FloatArray) -> str:
        parts = self.weighing.parts
        noise = np.array([parts[each.component].noise_m > 0.0 for each in self.candidates])
        moved = np.array([bool(parts[each.component].name) for each in self.candidates]) & ~noise
        if share[noise].sum() > SURE:
            best = int(np.argmax(np.where(noise, share, 0.0)))
            noise_mm = 1e3 * parts[self.candidates[best].component].noise_m
            return (
                f"the sensor seems noisier than is known of it ({share[noise].sum():.1%}): by "
                f"about {noise_mm:.2g} mm; counted so"
            )
        if share[moved].sum() <= SURE:
            return ""
        return (
            f"the sensor does not seem to stand where the profile says ({share[moved].sum():.1%}): "
            f"the tool appears about {self._distance_mm(run, share, moved):.2g} mm off"
            f"{ALLOWED_FOR}. `failuretwin robot fit` on healthy runs finds its frame"
        )

    def _distance_mm(self, run: int, share: FloatArray, moved: BoolArray) -> float:
        """Return how far the sensor's frame moves the tool of a run in the mean [mm]."""
        each = self.candidates[int(np.argmax(np.where(moved, share, 0.0)))]
        at = np.flatnonzero(each.rows == run)
        theta = each.found.expansion.place[at] + each.found[at].best(self.weighing.log_odds)[0]
        evidence = self.weighing.likelihood.evidence
        seen = evidence.point[run][evidence.usable[run]]
        return 1e3 * float(np.linalg.norm(registered(seen[None], theta)[0] - seen, axis=1).mean())
