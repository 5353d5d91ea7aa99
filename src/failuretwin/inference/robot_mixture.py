"""Which healthy robot runs are of: the calibration that is named, or another robot of its kind.

    p(h | run) = sum over c of p(c | run) p(h | run, c)
    p(c | run) ~ w_c sum over h of p(h) p(run | h, c)

with components c of the belief about the healthy robot: the named calibration; the population of
its class, whose scatter and noise the engine sums over; and that with more lost commands.
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
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.nonidealities import with_rates
from failuretwin.inference.engine.registration import robot_evidence, run_posterior
from failuretwin.inference.engine.runs import has_rows
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.posterior import Posterior

LOSSES = {3.0: 0.15}
"""Factors on the rates of lost commands of the class, and the share of robots of each; assumed."""
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


def robot_components(model: HealthyModel, priors: Priors) -> list[RobotComponent]:
    """Return what is believed of a healthy robot; the first is the model itself.

    An ideal robot, one whose set-up is known, and one that other sensors watch have no other.

    Args:
        model: The named calibration, or the population of its class.
        priors: Beliefs about set-ups.
    """
    another, known = priors.setup.another_rate, model.imperfections
    if another == 0.0 or known.settling is None or not model.sensors.tool_alone:
        return [RobotComponent("", 0.0, model)]
    if known.of_class:
        return _population(model, "", 1.0)
    name = f"these runs do not seem to be of the robot of calibration {known.name!r}"
    usual = generic_imperfections(model.twin.robot)
    usual = replace(usual, protocol=known.protocol, sensors=known.sensors)
    kind = _population(replace(model, imperfections=usual), name, another)
    return [RobotComponent("", float(np.log1p(-another)), model), *kind]


def _population(model: HealthyModel, name: str, rate: float) -> list[RobotComponent]:
    """Return the population of a class: as usual first, then with more lost commands.

    Args:
        model: The population.
        name: What is said of a run that it explains.
        rate: Probability of the population.
    """
    usual = rate * (1.0 - sum(LOSSES.values()))
    found = [RobotComponent(name, float(log_of(usual)), model)]
    for factor, share in LOSSES.items():
        lossy = replace(model, imperfections=with_rates(model.imperfections, factor))
        told = f"commands seem to get lost about {factor:g} times as often as with such arms"
        told = "; ".join(filter(None, (name, told)))
        found.append(RobotComponent(told, float(log_of(rate * share)), lossy))
    return found


@dataclass(frozen=True)
class RobotPosterior:
    """What some of the runs say if one component is true.

    Attributes:
        component: The component.
        rows: Indices of the runs.
        posterior: Of these runs.
    """

    component: RobotComponent
    rows: IntArray
    posterior: Posterior

    @property
    def settled(self) -> FloatArray:
        """Log of w_c sum over h of p(h) p(run | h, c) by settled positions, (row,)."""
        return self.component.log_weight + self.posterior.settled_evidence

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
        mixture = cls([RobotPosterior(first, np.arange(len(named.log_posterior)), named)], common)
        for one in others:
            likelihood = RunLikelihood(alone.evidence, one.model)
            some = mixture.rows_to_weigh(one, likelihood, priors)
            if len(some):
                doubt = in_doubt and one is others[0]
                says = run_posterior(likelihood[some], named.hypotheses, priors, doubt)
                mixture = cls([*mixture.parts, RobotPosterior(one, some, says)], common)
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
        scored = [i for i in many if asked[:, i].any() and has_rows(known.hypotheses[i])]
        if not scored:
            return np.arange(len(best))
        some = [known.hypotheses[i] for i in scored]
        glance = _glance(likelihood, some, priors, asked[:, scored])
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
    """Return the log evidence of some hypotheses, (run, hypothesis).

    Args:
        likelihood: Runs by their settled positions.
        hypotheses: Those with rows.
        priors: Beliefs about faults and set-ups.
        asked: Which are weighed, (run, hypothesis); the others have none.
    """
    found = np.full(asked.shape, -np.inf)
    for which in np.unique(asked, axis=0):
        rows = np.flatnonzero((asked == which).all(axis=1))
        some = [hypotheses[i] for i in np.flatnonzero(which).tolist()]
        says = robot_evidence(likelihood[rows], some, priors)
        found[np.ix_(rows, np.flatnonzero(which))] = says
    return found
