"""Runs of an arm whose offsets and sensor are in doubt, seen without any noise but its scatter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.nonidealities import Imperfections, Variation
from failuretwin.digital_model.settling import Settling
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.engine.theta import offsets_of
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence, SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.registered import registered_evidence

SETTLING = Settling(
    bias=(0.01, -0.02, 0.03, -0.01),
    compliance=(0.0, 0.1, 0.15, 0.2),
    friction=(0.005, 0.006, 0.007, 0.008),
    scatter=(0.004, 0.005, 0.006, 0.007),
)
"""Normal scatter; motor 1 carries no load."""
DOUBT = Variation(bias=(0.01,) * 4, compliance=(0.3,) * 4, friction=(0.004,) * 4)
WIDTH = np.array([0.003] * 3 + [0.01] * 4 + [0.01] * 4 + [0.03] * 4 + [0.004] * 4)
"""About how far each part of theta may be off."""
FAULTS = ["motor_2:stuck", "motor_3:steady_state_error", "motor_2:encoder_bias", "motor_4:drift"]


@dataclass(frozen=True)
class Scene:
    """Some runs of one hypothesis, and what is known of the arm."""

    evidence: SettledEvidence
    model: HealthyModel
    hypothesis: Hypothesis


def scene(twin, name, runs=2, dof=np.inf, lost=(), count=6, seed=3, doubt=DOUBT):
    """Return runs of a hypothesis in text."""
    settling = replace(SETTLING, tail_dof=dof)
    known = Imperfections("made up", "test", settling=settling, lost_commands=lost)
    state = Hypothesis.parse(name)
    plan = Plan(twin.robot, [state], runs, seed, known, RandomMovements(count=count))
    model = HealthyModel(twin, replace(known, variation=doubt))
    return Scene(Evidence(simulate(plan), model.settings).settled, model, state)


def drawn_from_its_model(healthy: Scene, seed=0):
    """Return a healthy scene whose tool stands where the model itself would draw it."""
    rng, model = np.random.default_rng(seed), healthy.model.without_doubt
    evidence = healthy.evidence
    origin = np.concatenate(
        [evidence.movements.initial[:, None], evidence.movements.target[:, :-1]], axis=1
    )
    target = evidence.movements.target
    pose = model.settle(target, np.sign(target - origin), model.none_held)
    path, jacobian = model.twin.path_and_jacobian(pose)
    moved = rng.normal(size=pose.shape) * model.scatter
    off = np.einsum("...ak,...k->...a", jacobian, moved)
    off += model.path_noise * rng.normal(size=path.shape)
    dof = model.settling.tail_dof
    if np.isfinite(dof):
        off /= np.sqrt(rng.chisquare(dof, path.shape[:-1]) / dof)[..., None]
    return replace(healthy, evidence=replace(evidence, point=path + off))


def whole(one, theta):
    """Return what runs say with theta (19,) as known, all computed anew."""
    model = one.model.without_doubt
    settling = offsets_of(theta, model.settling)
    known = replace(model.imperfections, settling=settling)
    place = np.tile(theta, (len(one.evidence.point), 1))
    return RunLikelihood(registered_evidence(one.evidence, place), HealthyModel(model.twin, known))


def some_theta(seed, share):
    """Return a theta at random, in shares of `WIDTH`."""
    return share * WIDTH * np.random.default_rng(seed).normal(size=19)
