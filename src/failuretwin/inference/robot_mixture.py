"""Which healthy robot runs are of: the calibration that is named, or another robot of its kind.

    p(h | run) = sum over c of p(c | run) p(h | run, c)
    p(c | run) ~ w_c sum over h of p(h) p(run | h, c)

with components c of the belief about the healthy robot: the named calibration, and the population
of its class, whose scatter, noise and losses the engine sums over. p(c | run) is that of settled
positions, which both judge. The population is weighed in full for the runs that it may explain
better: its healthy hypothesis and the likeliest so far tell which.

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
from failuretwin.inference.engine.registration import robot_evidence, run_posterior
from failuretwin.inference.engine.runs import has_rows
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.posterior import Posterior

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

    A robot of its class, an ideal one, one whose set-up is known, and one that other sensors watch
    have no other.

    Args:
        model: The named calibration, or the population of its class.
        priors: Beliefs about set-ups.
    """
    another, known = priors.setup.another_rate, model.imperfections
    nothing = another == 0.0 or known.settling is None or known.of_class
    if nothing or not model.sensors.tool_alone:
        return [RobotComponent("", 0.0, model)]
    usual = generic_imperfections(model.twin.robot)
    usual = replace(usual, protocol=known.protocol, sensors=known.sensors)
    told = f"these runs do not seem to be of the robot of calibration {known.name!r}"
    kind = RobotComponent(told, float(log_of(another)), replace(model, imperfections=usual))
    return [RobotComponent("", float(np.log1p(-another)), model), kind]


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
        """Weigh the other component, if there is one, where it may explain a run better.

        Args:
            named: Posterior by the first component.
            components: Beliefs about the healthy robot.
            priors: Beliefs about faults and set-ups.
            in_doubt: Whether the sensor may stand elsewhere.
            common: What is said of the log of all runs.
        """
        first, *others = components
        parts = [RobotPosterior(first, np.arange(len(named.log_posterior)), named)]
        for one in others:
            likelihood = RunLikelihood(named.likelihood.evidence, one.model)
            some = cls(parts, common).rows_to_weigh(one, likelihood, priors)
            if len(some):
                says = run_posterior(likelihood[some], named.hypotheses, priors, in_doubt)
                parts.append(RobotPosterior(one, some, says))
        return cls(parts, common)

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
        """Return the runs that another component may explain better.

        Its healthy hypothesis tells, and the best one so far.
        """
        known, best = self.parts[0].posterior, np.argmax(self.log_posterior, axis=1)
        many = range(len(known.hypotheses))
        asked = best[:, None] == np.array(many)
        asked |= [h.is_healthy for h in known.hypotheses]
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
