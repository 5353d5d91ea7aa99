"""A sensor that may stand elsewhere than the profile says: whether, and where.

    p(run | h) = sum over c of w_c  integral of p(run | h, theta) N(theta; 0, V_c) dtheta

over components c: that the sensor is where the profile says, and that origin, turn, scale or all
three are displaced. G is linear about a registration, so runs are registered first, from coarse to
fine: what a displaced frame leaves must not look like outliers.

Section: docs/inference.md#shared-unknowns
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.engine.posterior import misfit_of, theta_factors
from failuretwin.inference.engine.runs import has_rows
from failuretwin.inference.engine.theta import (
    AS_TOLD,
    OF_CLASS,
    SINCE_CALIBRATED,
    Components,
    Layout,
    ScaleFactors,
    layout_of,
    robot_components,
)
from failuretwin.inference.engine.weighing import Weighing, assembled
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.registered import REGISTRATION
from failuretwin.inference.posterior import Posterior, compute_posterior, marginal_likelihoods
from failuretwin.inference.set_ups.setup_prior import SetupPrior
from failuretwin.inference.unasked_faults import unasked_faults

COARSE_TO_FINE = (0.026, 0.004, 0.0)
"""Noise added while a displaced sensor is registered, as shares of the reach."""
ILL_FITTING = 8.0
"""Mean squared distance of a movement above which nothing explains a run, in scales: three axes
give three if all is well."""
SUSPECT_NATS, SUSPECT_RUN_NATS, SUSPECT_SHARE = 12.0, 0.2, 0.3
"""A displaced sensor is weighed where one registration of all runs would explain them better by so
much, half of the runs by so much each, or where so large a share fits ill."""
SAMPLED_RUNS, FEW_RUNS = 24, 10
"""Runs from which the registration of a run set is found; fewer than the second number have a
registration each."""


def robot_weighing(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> Weighing:
    """Return runs of a robot whose sensor is where the profile says."""
    layout, components = _usual(likelihood, priors.setup)
    place = np.zeros((len(likelihood.usable), REGISTRATION))
    return Weighing(likelihood, hypotheses, priors, layout, components, place)


def displaced_weighing(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors, place: FloatArray
) -> Weighing:
    """Return runs of a robot whose sensor may be displaced, each about a registration (run, 7)."""
    layout, usual = _usual(likelihood, priors.setup)
    components = displaced_components(likelihood.model, priors.setup, layout, usual)
    components = components.about(np.pad(place, ((0, 0), (0, layout.size - REGISTRATION))))
    if place.any():  # rows are chosen by a sensor that stands right there
        there = usual.first.weighted(0.0).about(np.zeros((len(place), layout.size)))
        components = Components.joined([there, components])
    return Weighing(likelihood, hypotheses, priors, layout, components, place)


def _usual(likelihood: RunLikelihood, setup: SetupPrior) -> tuple[Layout, Components]:
    model = likelihood.model
    layout = layout_of(model.without_doubt, bool(likelihood.evidence.on_the_way.any()))
    return layout, robot_components(model, layout, _factors(model, setup))


def _factors(model: HealthyModel, setup: SetupPrior) -> ScaleFactors:
    """Return what is unknown of scatter and noise.

    Nothing of a robot that is said to be ideal, or surely the one of its calibration and unchanged.
    """
    if model.scatter_factor != 1.0 or model.imperfections.settling is None:
        return AS_TOLD
    if model.imperfections.of_class:
        return OF_CLASS
    return SINCE_CALIBRATED if setup.another_rate > 0.0 else AS_TOLD


def displaced_components(
    model: HealthyModel, prior: SetupPrior, layout: Layout, usual: Components
) -> Components:
    """Return what is believed of a robot whose sensor may be displaced; first, that it is not.

    Args:
        model: The healthy robot.
        prior: How far set-ups may be off.
        layout: Places in theta.
        usual: What is believed of the robot with its sensor where the profile says.
    """
    reach = model.twin.robot.reach
    near, far = (share * reach for share in prior.origin)
    little, much = prior.turn_rad
    cases = [
        (prior.all_rate, 0.5 * (near + far), 0.5 * (little + much), prior.scale),
        (prior.origin_rate / 2, near, 0.0, 0.0),
        (prior.origin_rate / 2, far, 0.0, 0.0),
        (prior.turn_rate / 2, 0.0, little, 0.0),
        (prior.turn_rate / 2, 0.0, much, 0.0),
        (prior.scale_rate, 0.0, 0.0, prior.scale),
    ]
    found = [usual.weighted(1.0 - prior.doubt)]
    for share in prior.noise:
        noise = float(np.hypot(model.path_noise, share * reach))
        noisy = Components.normal_of(usual.covariance[0], noise)
        found.append(noisy.weighted(prior.noise_rate / 2))
    for rate, origin, turn, scale in cases:
        least = np.zeros(layout.size)
        least[:REGISTRATION] = np.repeat([origin, turn, scale], [3, 3, 1]) ** 2
        covariance = np.maximum(usual.covariance[0], np.diag(least))
        moved = Components.normal_of(covariance, float(model.path_noise), displaced=True)
        found.append(moved.weighted(rate))
    return Components.joined([one for one in found if np.isfinite(one.log_weight).any()])


def _about(
    likelihood: RunLikelihood,
    hypotheses: Sequence[Hypothesis],
    priors: Priors,
    place: FloatArray,
    share: float,
) -> Weighing:
    """Return runs about some registrations, with a broad prior of it and extra noise."""
    model = likelihood.model
    layout, usual = _usual(likelihood, priors.setup)
    frames = displaced_components(model, priors.setup, layout, usual)
    noise = float(np.hypot(model.path_noise, share * model.twin.robot.reach))
    ranked = [h for h in hypotheses if has_rows(h)]
    broad = Components.normal_of(np.maximum.reduce(frames.covariance), noise)
    broad = broad.about(np.pad(place, ((0, 0), (0, layout.size - REGISTRATION))))
    settled = replace(likelihood, moving=None)
    return Weighing(settled, ranked, priors, layout, broad, place)


def registered_each(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> FloatArray:
    """Return a registration of each run, from coarse to fine, (run, 7)."""
    place = np.zeros((len(likelihood.usable), REGISTRATION))
    for share in COARSE_TO_FINE:
        weighing = _about(likelihood, hypotheses, priors, place, share)
        place = place + weighing.best[1][:, :REGISTRATION]
    return place


def registered_together(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> FloatArray:
    """Return one registration of all runs, (7,): the median of some, then theirs together."""
    count = len(likelihood.usable)
    rows = np.unique(np.linspace(0, count - 1, min(count, SAMPLED_RUNS)).astype(np.int64))
    some = likelihood[rows]
    place = np.median(registered_each(some, hypotheses, priors), axis=0)
    for share in (COARSE_TO_FINE[1], 0.0, 0.0):
        weighing = _about(some, hypotheses, priors, np.tile(place, (len(rows), 1)), share)
        information, shift = (one.sum(axis=0) for one in theta_factors(weighing.evidence))
        broad = weighing.components
        precision = np.linalg.inv(broad.covariance[0])
        force = shift + precision @ broad.mean[0, 0]
        place = place + np.linalg.solve(information + precision, force)[:REGISTRATION]
    return place


def sensor_in_doubt(
    likelihood: RunLikelihood,
    hypotheses: Sequence[Hypothesis],
    priors: Priors,
    known: Sequence[Weighing] = (),
) -> bool:
    """Return whether runs that share a set-up say that the sensor may be displaced.

    Those that two faults explain best say nothing of it.

    Args:
        likelihood: Some of the runs, as they were seen.
        hypotheses: What may be the case.
        priors: Beliefs about faults and set-ups.
        known: The same runs weighed, where they were (`robot_parts`).
    """
    ranked = [h for h in hypotheses if has_rows(h)]
    if priors.setup.doubt == 0.0 or not ranked or not likelihood.model.sensors.tool_alone:
        return False
    settled = replace(likelihood, moving=None)
    told = [*ranked, *(h for h in hypotheses if len(h.faults) > 1)]
    parts = known or robot_parts(settled, told, priors)
    columns = [list(parts[0].hypotheses).index(h) for h in told]
    best = np.argmax(np.concatenate([one.log_joint_at_rest[:, columns] for one in parts]), axis=1)
    single = np.flatnonzero(best < len(ranked))
    return bool(len(single)) and _suspect(settled[single], ranked, priors, best[single])


def _suspect(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors, best: IntArray
) -> bool:
    """Return whether the sensor may be displaced, by the most probable hypothesis of each run."""
    layout, usual = _usual(likelihood, priors.setup)
    size, narrow = layout.size, usual.first
    information, shift = np.zeros((len(best), size, size)), np.zeros((len(best), size))
    ill: BoolArray = np.zeros(len(best), dtype=bool)
    for h in np.unique(best).tolist():
        rows = np.flatnonzero(best == h)
        place = np.zeros((len(rows), REGISTRATION))
        some = Weighing(likelihood[rows], [hypotheses[h]], priors, layout, narrow, place)
        information[rows], shift[rows] = theta_factors(some.evidence)
        ill[rows] = misfit_of(some.evidence) > ILL_FITTING
    frames = displaced_components(likelihood.model, priors.setup, layout, usual)
    own, rest = slice(None, REGISTRATION), slice(REGISTRATION, None)
    known = np.linalg.inv(usual.covariance[0])[rest, rest]  # each run has offsets of its own
    left = np.linalg.solve(information[:, rest, rest] + known, information[:, rest, own])
    shift = shift[:, own] - np.einsum("rtu,rt->ru", left, shift[:, rest])
    information = information[:, own, own] - information[:, own, rest] @ left
    broad = np.linalg.inv(np.maximum.reduce(frames.covariance)[own, own])
    step = np.linalg.solve(information.sum(axis=0) + broad, shift.sum(axis=0))
    gain = 0.5 * float(shift.sum(axis=0) @ step)
    of_run = shift @ step - 0.5 * np.einsum("t,rtu,u->r", step, information, step)
    together = gain > SUSPECT_NATS and float(np.median(of_run)) > SUSPECT_RUN_NATS
    return together or bool(ill.mean() > SUSPECT_SHARE)


# The posterior of runs in chunks, each about the better of two registrations.

ANOTHER_SENSOR = 0.02
"""Probability that a run is of another sensor than the others of its set; assumed."""
TELLS_NATS = 5.0
"""What one run says at most against a noise of the sensor [nats]."""

CHUNK_ROWS = 1600
"""Moments of all runs that are weighed at a time, times those of a run: rows grow with them, and
what all rows say of outcomes stays below 100 MB."""


def robot_posterior(
    likelihood: RunLikelihood,
    hypotheses: Sequence[Hypothesis],
    priors: Priors,
    known: Sequence[Weighing] = (),
) -> Posterior:
    """Return the posterior of runs whose sensor is where the profile says.

    Args:
        likelihood: The runs as they were seen.
        hypotheses: What may be the case.
        priors: Beliefs about faults and set-ups.
        known: The same runs weighed by where they rest, where they were (`robot_parts`).
    """
    chunks = _chunks(likelihood)
    parts = known or robot_parts(likelihood, hypotheses, priors)
    if known and likelihood.moving is not None:
        pairs = zip(known, chunks, strict=True)
        parts = [one.seen_moving(likelihood.moving[rows]) for one, rows in pairs]
    some = [looked_further(one) for one in _of_one_sensor(parts, SUSPECT_NATS)]
    return assembled(likelihood, some, *_in_turn(chunks))


def looked_further(weighing: Weighing) -> Posterior:
    """Return the posterior of runs with what explains them better and is no hypothesis."""
    return replace(weighing.posterior(), unasked=unasked_faults(weighing))


def robot_evidence(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> FloatArray:
    """Return log p(run | h) of runs whose sensor is where the profile says, (run, hypothesis)."""
    parts = robot_parts(likelihood, hypotheses, priors)
    return np.concatenate([one.by_hypothesis for one in parts])


def evidence_at_once(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> FloatArray:
    """Return log p(run | h), theta as told where every reading is at rest, (run, hypothesis)."""
    ranked = any(has_rows(h) for h in hypotheses)
    if ranked and likelihood.evidence.on_the_way.any():
        return robot_evidence(likelihood, hypotheses, priors)
    says = marginal_likelihoods(likelihood, hypotheses, priors)
    return np.stack([one.log_evidence for one in says], axis=1)


def robot_parts(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> list[Weighing]:
    """Return runs whose sensor is where the profile says, in chunks."""
    chunks = _chunks(likelihood)
    return [robot_weighing(likelihood[rows], hypotheses, priors) for rows in chunks]


def displaced_posterior(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> Posterior:
    """Return the posterior of runs whose sensor may be displaced."""
    parts, better = _about_the_better(likelihood, hypotheses, priors)
    some = [looked_further(one) for one in parts]
    chunks = _chunks(likelihood)
    part, row = _in_turn(chunks)
    return assembled(likelihood, some, part + len(chunks) * better, row)


def displaced_evidence(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> FloatArray:
    """Return log p(run | h) of runs whose sensor may be displaced, (run, hypothesis)."""
    parts, better = _about_the_better(likelihood, hypotheses, priors)
    table = np.concatenate([one.by_hypothesis for one in parts])
    runs = len(better)
    return table[np.arange(runs) + runs * better]


def _about_the_better(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> tuple[list[Weighing], IntArray]:
    """Return chunks of runs about their registrations, and which explains each run better."""
    runs = len(likelihood.usable)
    if runs >= FEW_RUNS:
        places = [np.tile(registered_together(likelihood, hypotheses, priors), (runs, 1))]
    else:  # one by itself may be registered wrongly
        own = registered_each(likelihood, hypotheses, priors)
        places = [own, np.zeros_like(own)]
    chunks = _chunks(likelihood)
    parts: list[Weighing] = []
    for where in places:
        of = [displaced_weighing(likelihood[k], hypotheses, priors, where[k]) for k in chunks]
        parts += _of_one_sensor(of)
    if len(places) == 1:
        return parts, np.zeros(runs, dtype=np.int64)
    total = np.concatenate([one.total for one in parts]).reshape(len(places), runs)
    return parts, np.argmax(total, axis=0)


def _of_one_sensor(parts: Sequence[Weighing], least_nats: float = -np.inf) -> Sequence[Weighing]:
    """Return runs of one sensor, each with what the others say of its noise n.

        w_c(run i) ~ w_c p(n_c | the others) / p(n_c),    p(n | the others) ~ p(n) prod p(run j | n)

    With a small probability the others are of another sensor.

    Args:
        parts: The runs.
        least_nats: Log odds of more noise than is known of the sensor, by all runs, from which they
            tell each other.
    """
    components, log_weight = parts[0].components, parts[0].components.log_weight
    levels, of = np.unique(components.noise_m, return_inverse=True)
    own = np.eye(len(levels), dtype=bool)[of]  # (component, level)
    prior = log_sum(np.where(own, log_weight[:, None], -np.inf), axis=0)
    joint = np.concatenate([log_sum(one.log_evidence + one.log_odds, axis=2) for one in parts])
    says = log_sum(np.where(own, joint[..., None], -np.inf), axis=1) - prior
    says = np.maximum(says, says.max(axis=1, keepdims=True) - TELLS_NATS)
    together = prior + says.sum(axis=0)
    noisier, usual = (
        log_sum(np.where(some, together, -np.inf), axis=0)
        for some in (levels > levels[of[0]], levels <= levels[of[0]])
    )
    if not noisier - usual > least_nats:
        return parts
    others = together - says
    others = others - log_sum(others, axis=1)[:, None]
    alone = prior - log_sum(prior, axis=0)
    shared = np.logaddexp(np.log1p(-ANOTHER_SENSOR) + others, np.log(ANOTHER_SENSOR) + alone)
    gain = (shared - alone)[:, of]
    ends = np.cumsum([len(one.place) for one in parts])[:-1]
    pairs = zip(parts, np.split(gain, ends), strict=True)
    return [one.reweighted(log_weight + more) for one, more in pairs]


def _chunks(likelihood: RunLikelihood) -> list[IntArray]:
    runs, moments = likelihood.usable.shape
    some = max(1, CHUNK_ROWS // max(moments, 1) ** 2)
    return [np.arange(at, min(at + some, runs)) for at in range(0, runs, some)]


def _in_turn(chunks: Sequence[IntArray]) -> tuple[IntArray, IntArray]:
    """Return the chunk and the place in it of each run."""
    sizes = [len(one) for one in chunks]
    return np.repeat(np.arange(len(sizes)), sizes), np.concatenate([np.arange(n) for n in sizes])


def run_posterior(
    likelihood: RunLikelihood,
    hypotheses: Sequence[Hypothesis],
    priors: Priors,
    in_doubt: bool,
    known: Sequence[Weighing] = (),
) -> Posterior:
    """Weigh every hypothesis by some runs, what they share integrated out.

    Where no hypothesis has rows, theta is taken as told.

    Args:
        likelihood: The runs as they were seen.
        hypotheses: What may be the case.
        priors: Beliefs about faults and set-ups.
        in_doubt: Whether their sensor may be displaced.
        known: The same runs weighed by where they rest, with a sensor that is not, where they were.
    """
    moving = likelihood.evidence.on_the_way
    if moving.any() and not moving.all():
        kinds = [np.flatnonzero(moving == kind) for kind in (False, True)]
        parts = [run_posterior(likelihood.alike(k), hypotheses, priors, in_doubt) for k in kinds]
        place = np.empty(len(moving), dtype=np.int64)
        for rows in kinds:
            place[rows] = np.arange(len(rows))
        return assembled(likelihood, parts, moving.astype(np.int64), place)
    if not any(has_rows(h) for h in hypotheses):
        return compute_posterior(likelihood, hypotheses, priors)
    if in_doubt:
        return displaced_posterior(likelihood, hypotheses, priors)
    return robot_posterior(likelihood, hypotheses, priors, known)
