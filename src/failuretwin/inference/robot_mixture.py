"""Which healthy robot runs are of: the calibration that is named, or another robot of its kind.

    p(h | run) = sum over c of p(c | run) p(h | run, c)
    p(c | run) ~ w_c sum over h of p(h) p(run | h, c)

with components c of the belief about the healthy robot: the named calibration; the population of
its class; and that population with more lost commands, a larger scatter or a noisier sensor. The
engine sums over scatter and noise itself where rests tell of all hypotheses.
p(c | run) is that of settled positions, which every component judges. A component is weighed in
full for the runs that it may explain better: its healthy and its likeliest hypothesis tell which.

Section: docs/inference.md#robot-mixture
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_of, log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.digital_model.arm_classes import GENERIC_NAME, generic_imperfections
from failuretwin.digital_model.nonidealities import with_rates
from failuretwin.inference.engine.unknown_robots import evidence_by_hypothesis, speaks_of
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.posterior import Posterior
from failuretwin.inference.theta.shared_likelihood import has_score
from failuretwin.inference.theta.shared_posterior import shared_posterior
from failuretwin.inference.theta.shared_weighing import SharedWeighing

USUAL = 0.4
"""Share of robots that scatter as their class does, lose as many commands and are seen as well;
this and the shares below are assumed: three in five arms were built, mounted or worn otherwise than
the class says."""
SCATTER = {2.0: 0.25, 4.0: 0.05}
"""Factors on the scatter of the class, and the share of robots of each [-]."""
LOSSES = {3.0: 0.15}
"""Factors on its rates of lost commands, and the share of robots of each [-]."""
NOISY = 0.15
"""Share of robots whose sensor is noisier than is known, for both lengths of `SetupPrior.noise`."""
COUNTS_NATS = 3.0
"""A component counts for a run where it comes within this of what explains the run best [nats]."""
TOLD = 0.9
"""Probability of the other components from which a run says which it was judged by."""


@dataclass(frozen=True)
class RobotComponent:
    """One belief about the healthy robot.

    Attributes:
        told: What a run says that is judged by it; empty: nothing.
        log_weight: Log of its probability.
        model: The healthy robot.
    """

    told: str
    log_weight: float
    model: HealthyModel


def robot_components(
    model: HealthyModel, priors: Priors, factors: bool = True
) -> list[RobotComponent]:
    """Return what is believed of a healthy robot; the first is the model itself.

    An ideal robot, one whose set-up is known, and one that other sensors watch have no other.

    Args:
        model: The named calibration, or the population of its class.
        priors: Beliefs about set-ups.
        factors: Whether scatter and noise are components here; else the engine sums over them.
    """
    another, known = priors.setup.another_rate, model.imperfections
    if another == 0.0 or known.settling is None or not model.sensors.tool_alone:
        return [RobotComponent("", 0.0, model)]
    if known.name == GENERIC_NAME:
        return _population(model, priors, "", factors)
    name = f"these runs do not seem to be of the robot of calibration {known.name!r}"
    usual = generic_imperfections(model.twin.robot)
    usual = replace(usual, protocol=known.protocol, sensors=known.sensors)
    kind = _population(replace(model, imperfections=usual), priors, name, factors)
    others = [replace(one, log_weight=one.log_weight + float(log_of(another))) for one in kind]
    return [RobotComponent("", float(np.log1p(-another)), model), *others]


def _population(
    model: HealthyModel, priors: Priors, name: str, factors: bool
) -> list[RobotComponent]:
    """Return the population of a class: as usual first, then what differs from it."""
    usual = USUAL if factors else 1.0 - sum(LOSSES.values())
    known, found = model.imperfections, [(name, usual, model)]
    settling = known.settling
    assert settling is not None
    for factor, share in SCATTER.items() if factors else ():
        scatter = tuple(factor * value for value in settling.scatter)
        wide = replace(known, settling=replace(settling, scatter=scatter))
        told = f"the motors seem to scatter about {factor:g} times as much as arms of this class do"
        found.append((told, share, replace(model, imperfections=wide)))
    for factor, share in LOSSES.items():
        told = f"commands seem to get lost about {factor:g} times as often as with such arms"
        found.append((told, share, replace(model, imperfections=with_rates(known, factor))))
    for share in priors.setup.noise if factors else ():
        noise = float(np.hypot(model.untold_noise_m, share * model.twin.robot.reach))
        told = f"the sensor seems noisier than is known of it: by about {1e3 * noise:.2g} mm"
        found.append((told, NOISY / 2.0, replace(model, untold_noise_m=noise)))
    return [
        RobotComponent("; ".join(filter(None, dict.fromkeys((name, told)))), float(np.log(w)), one)
        for told, w, one in found
    ]


@dataclass(frozen=True)
class RobotPosterior:
    """What some of the runs say if one component is true.

    Attributes:
        component: The component.
        rows: Indices of the runs.
        posterior: Of these runs.
        settled: Log of w_c sum over h of p(h) p(run | h, c) by settled positions, (row,).
    """

    component: RobotComponent
    rows: IntArray
    posterior: Posterior
    settled: FloatArray

    @classmethod
    def of(
        cls, component: RobotComponent, rows: IntArray, posterior: Posterior, settled: Posterior
    ) -> RobotPosterior:
        """Return it from the posterior of all readings, and that of settled positions alone."""
        evidence = np.stack([one.log_evidence for one in settled.weights], axis=1)
        says = log_sum(evidence + settled.log_prior, axis=1)
        return cls(component, rows, posterior, component.log_weight + says)

    @property
    def told(self) -> str:
        """What a run says that is judged by it."""
        return f"{self.component.told}; judged so" if self.component.told else ""


@dataclass(frozen=True)
class RobotMixture:
    """What some runs say in all components that count.

    Attributes:
        parts: By component; the first holds all runs.
        common: What is said of the log of all runs; the first component's posterior says it.
    """

    parts: Sequence[RobotPosterior]
    common: Sequence[str]

    @classmethod
    def of(
        cls,
        named: Posterior,
        components: Sequence[RobotComponent],
        priors: Priors,
        in_doubt: bool,
        common: Sequence[str] = (),
    ) -> RobotMixture:
        """Weigh the other components where they may explain a run better.

        Args:
            named: Posterior by the first component.
            components: Beliefs about the healthy robot.
            priors: Beliefs about faults and set-ups.
            in_doubt: Whether the sensor may stand elsewhere: weighed with the first two, since what
                differs from the usual robot explains the same runs.
            common: What is said of the log of all runs.
        """
        first, *others = components
        alone = replace(named.likelihood, moving=None)
        settled, rows = named, np.arange(len(named.log_posterior))
        if others and named.likelihood.moving is not None:
            settled = shared_posterior(alone, named.hypotheses, priors, in_doubt)
        mixture = cls([RobotPosterior.of(first, rows, named, settled)], common)
        for one in others:
            likelihood = RunLikelihood(alone.evidence, one.model)
            some = mixture.rows_to_weigh(one, likelihood, priors)
            if len(some):
                doubt = in_doubt and one is others[0]
                says = shared_posterior(likelihood[some], named.hypotheses, priors, doubt)
                part = RobotPosterior.of(one, some, says, says)
                mixture = cls([*mixture.parts, part], common)
        return mixture

    @cached_property
    def log_joint(self) -> FloatArray:
        """Log p(c, h, run) up to a constant of the run, (component, run, hypothesis)."""
        found = np.full((len(self.parts), *self.parts[0].posterior.log_posterior.shape), -np.inf)
        for i, part in enumerate(self.parts):
            found[i, part.rows] = part.settled[:, None] + part.posterior.log_posterior
        return found

    @cached_property
    def log_posterior(self) -> FloatArray:
        """Log p(h | run), (run, hypothesis)."""
        joint = log_sum(self.log_joint, axis=0)
        return np.asarray(joint - log_sum(joint, axis=1)[:, None])

    def rows_to_weigh(
        self, component: RobotComponent, likelihood: RunLikelihood, priors: Priors
    ) -> IntArray:
        """Return the runs that a component may explain better, by its healthy hypothesis.

        The first component behind the named one is asked for the best hypothesis so far too.
        """
        known, best = self.parts[0].posterior, np.argmax(self.log_posterior, axis=1)
        many = range(len(known.hypotheses))
        asked = np.tile([h.is_healthy for h in known.hypotheses], (len(best), 1))
        if len(self.parts) == 1:
            asked = asked | (best[:, None] == np.array(many))
        scored = [i for i in many if asked[:, i].any() and has_score(known.hypotheses[i])]
        if not scored:
            return np.arange(len(best))
        some = [known.hypotheses[i] for i in scored]
        weigh = _glance_at_rests if speaks_of(likelihood, known.hypotheses) else _glance
        glance = weigh(likelihood, some, priors, asked[:, scored])
        says = component.log_weight + (glance + known.log_prior[scored]).max(axis=1)
        reached = log_sum(log_sum(self.log_joint, axis=0), axis=1)
        return np.flatnonzero(says > reached - COUNTS_NATS)

    def of_run(self, run: int) -> tuple[Posterior, int]:
        """Return the posterior of the component behind a run's best hypothesis, and its row there.

        Its hypotheses are as probable as all components together make them.
        """
        best = int(np.argmax(self.log_posterior[run]))
        part = self.parts[int(np.argmax(self.log_joint[:, run, best]))]
        row = int(np.searchsorted(part.rows, run))
        posterior = np.array(part.posterior.log_posterior)
        posterior[row] = self.log_posterior[run]
        said = list(part.posterior.set_up) or [""] * len(part.rows)
        common = () if part is self.parts[0] else self.common
        told = part.told if self._another(run) > TOLD else ""
        said[row] = "; ".join(filter(None, (*common, said[row], told)))
        return replace(part.posterior, log_posterior=posterior, set_up=said), row

    def _another(self, run: int) -> float:
        """Return the probability of the other components than the first."""
        joint = log_sum(self.log_joint[:, run], axis=1)
        return float(1.0 - np.exp(joint[0] - log_sum(joint, axis=0)))


def _glance(
    likelihood: RunLikelihood,
    hypotheses: Sequence[Hypothesis],
    priors: Priors,
    asked: BoolArray,
) -> FloatArray:
    """Return the log evidence of some hypotheses by the usual offsets, searched for once.

    Args:
        likelihood: Runs by their settled positions.
        hypotheses: Those with a score.
        priors: Beliefs about faults and set-ups.
        asked: Which are weighed, (run, hypothesis); the others have none.
    """
    weighing = SharedWeighing(likelihood, hypotheses, priors)
    at = weighing.expand(np.arange(len(asked)), weighing.nowhere)
    prior = at.prior(weighing.parts[0].deviation)
    return weighing.search(at, prior, weighing.nowhere, asked).log_evidence


def _glance_at_rests(
    likelihood: RunLikelihood,
    hypotheses: Sequence[Hypothesis],
    priors: Priors,
    asked: BoolArray,
) -> FloatArray:
    """Return the log evidence of the hypotheses that are asked for by the engine, as `_glance`."""
    found = np.full(asked.shape, -np.inf)
    for which in np.unique(asked, axis=0):
        rows = np.flatnonzero((asked == which).all(axis=1))
        some = [hypotheses[i] for i in np.flatnonzero(which).tolist()]
        says = evidence_by_hypothesis(likelihood[rows], some, priors)
        found[np.ix_(rows, np.flatnonzero(which))] = says
    return found
