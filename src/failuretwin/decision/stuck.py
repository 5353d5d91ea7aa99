"""Evidence for a stuck motor: one unknown angle after an unknown onset, both integrated out.

The onset falls in one of two stretches for each movement: on the plateau before it (the motor
then stands where it had settled) or on its ramp (it stands somewhere on the way). From there on
the motor keeps its angle and the others behave as healthy ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from failuretwin.connection.healthy import Alternatives, HealthyModel
from failuretwin.core.quadrature import (
    log_of,
    log_sum,
    log_trapezoid_weights,
    weighted_quantiles,
)
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.settled_evidence import SettledEvidence

COARSE_NODES = 49
"""Nodes spread evenly over the range of the held angle."""
LOCAL_STEPS = np.array([-8, -5, -3.5, -2.5, -1.75, -1, -0.5, 0, 0.5, 1, 1.75, 2.5, 3.5, 5, 8.0])
"""Nodes around the angle that a movement points to, in its own standard deviations."""
PRIOR_STEPS = np.array([-5, -2.5, -1, 0, 1, 2.5, 5.0])
"""Nodes around each angle that the prior favours, in the scale of its peak."""
SETTLED_SCALE, ON_THE_WAY_SCALE = 2.0, 8.0
"""How sharply the prior ties the held angle to where the motor had settled, and to where its ramp
was at a known onset, in scatters of the motor."""
LAG_S = 0.045
"""Lag of the motion behind the command [s]: the servo loop's 0.025 s and a delay of 0 to 0.04 s."""
LAG_SPREAD_S = np.array([-0.02, 0.0, 0.02])
"""Steps by which the lag may differ from run to run [s]."""


@dataclass(frozen=True)
class OnsetPrior:
    """When a motor may have got stuck, and at what angle.

    Attributes:
        early: Probability that it was stuck before the run or gets stuck in its first movement;
            the rest is spread evenly over the time after that, up to the last movement.
        free: Probability that the held angle is unrelated to the commands, anywhere in range.
        known_s: The onset, where it is known [s].
    """

    early: float = 0.5
    free: float = 0.2
    known_s: float | None = None


@dataclass(frozen=True)
class StuckEvidence:
    """What the runs say of one motor being stuck.

    Attributes:
        log_evidence: Log marginal likelihood of each run, (run,).
        by_movement: Log density of each movement given all others, (run, movement).
        angle: Quantiles 5, 50, 95 % of the held angle, (run, 3) [rad].
        onset: Quantiles 5, 50, 95 % of the onset, (run, 3) [s].
    """

    log_evidence: FloatArray
    by_movement: FloatArray
    angle: FloatArray
    onset: FloatArray


def stuck_evidence(
    evidence: SettledEvidence,
    model: HealthyModel,
    alternatives: Alternatives,
    log_healthy: FloatArray,
    motor: int,
    prior: OnsetPrior,
) -> StuckEvidence:
    """Weigh the hypothesis that `motor` is stuck, for every run.

    Args:
        evidence: Settled positions.
        model: The healthy robot.
        alternatives: What may become of each movement.
        log_healthy: Log density of each movement if all is well, (run, movement).
        motor: Index of the motor.
        prior: When and where it may have got stuck.
    """
    angle = _angle_nodes(evidence, model, alternatives, motor, prior)
    log_stuck = _log_density(evidence, model, alternatives, motor, angle)
    # Movements before the onset are healthy, from the first affected one on the motor is held.
    before = np.cumsum(log_healthy, axis=1) - log_healthy
    after = np.cumsum(log_stuck[:, ::-1], axis=1)[:, ::-1]
    first_affected = before[:, :, None] + after
    joint = first_affected[:, :, None] + _log_prior(evidence, model, motor, angle, prior)
    log_evidence = log_sum(joint, axis=(1, 2, 3))
    posterior = np.exp(joint - log_evidence[:, None, None, None])
    log_posterior = log_sum(joint, axis=2) - log_evidence[:, None, None]
    return StuckEvidence(
        log_evidence=log_evidence,
        by_movement=_by_movement(log_healthy, log_stuck, log_posterior),
        angle=weighted_quantiles(angle, posterior.sum(axis=(1, 2)), (0.05, 0.5, 0.95)),
        onset=_onset_quantiles(evidence, motor, angle, posterior, prior.known_s),
    )


def _by_movement(
    log_healthy: FloatArray, log_stuck: FloatArray, log_posterior: FloatArray
) -> FloatArray:
    """Return the log density of each movement given all others, (run, movement).

    It is one over the posterior mean of one over its density. Onset and angle have the posterior
    `log_posterior` (run, movement first affected, node); a movement before the onset has the
    density `log_healthy` (run, movement), another `log_stuck` (run, movement, node).
    """
    affected = np.logaddexp.accumulate(log_posterior, axis=1)
    not_yet = np.full_like(log_healthy, -np.inf)
    later = log_sum(log_posterior, axis=2)[:, ::-1]
    not_yet[:, :-1] = np.logaddexp.accumulate(later, axis=1)[:, ::-1][:, 1:]
    inverse = np.logaddexp(log_sum(affected - log_stuck, axis=2), not_yet - log_healthy)
    return -inverse


def _angle_nodes(
    evidence: SettledEvidence,
    model: HealthyModel,
    alternatives: Alternatives,
    motor: int,
    prior: OnsetPrior,
) -> FloatArray:
    """Return angles to integrate over, sorted, (run, node) [rad].

    They crowd where the likelihood or the prior may have a peak.
    """
    low, high = _range(model, motor)
    coarse = np.broadcast_to(
        np.linspace(low, high, COARSE_NODES), (len(evidence.point), COARSE_NODES)
    )
    best, width = _best_angle(evidence, model, alternatives, motor)
    local = best[..., None] + width[..., None] * LOCAL_STEPS
    local = np.where(np.isfinite(local), local, low).reshape(len(coarse), -1)
    origin, target = _ends(evidence, motor)
    settled = np.concatenate([origin, target[:, -1:]], axis=1)
    scale = max(model.scatter[motor], 1e-4)
    tied = [settled[..., None] + SETTLED_SCALE * scale * PRIOR_STEPS]
    if prior.known_s is not None:
        way = _position_at(evidence, motor, prior.known_s)
        tied.append(way[..., None] + ON_THE_WAY_SCALE * scale * PRIOR_STEPS)
    nodes = [coarse, local, *(peaks.reshape(len(coarse), -1) for peaks in tied)]
    return np.sort(np.clip(np.concatenate(nodes, axis=1), low, high), axis=1)


def _range(model: HealthyModel, motor: int) -> tuple[float, float]:
    """Return the range of angles at which a motor may be held [rad]."""
    low, high = model.twin.robot.motors[motor].movement_range
    margin = 0.1 * (high - low)
    return low - margin, high + margin


def _best_angle(
    evidence: SettledEvidence, model: HealthyModel, alternatives: Alternatives, motor: int
) -> tuple[FloatArray, FloatArray]:
    """Return the angle of `motor` that brings the tool nearest to each point, and its scale.

    As one joint moves, the tool runs on a circle (a line, if the joint slides), so three poses
    say where all the others are. Both results are (run, movement) [rad].
    """
    pose = model.settle(
        alternatives.base[:, :, 0], alternatives.direction[:, :, 0], model.none_held
    )
    turns = np.array([0.0, 0.5 * np.pi, np.pi])
    poses = np.repeat(pose[..., None, :], 3, axis=-2)
    poses[..., motor] = turns
    path = model.twin.path(poses)
    if model.twin.robot.chain.joints[motor].prismatic:
        direction = (path[..., 2, :] - path[..., 0, :]) / np.pi
        lever = np.linalg.norm(direction, axis=-1)
        toward = evidence.point - path[..., 0, :]
        best = np.sum(toward * direction, axis=-1) / np.maximum(lever**2, 1e-12)
    else:
        centre = 0.5 * (path[..., 0, :] + path[..., 2, :])
        cosine, sine = path[..., 0, :] - centre, path[..., 1, :] - centre
        toward = evidence.point - centre
        best = np.arctan2(np.sum(toward * sine, axis=-1), np.sum(toward * cosine, axis=-1))
        lever = np.linalg.norm(cosine, axis=-1)
    width = np.hypot(model.scatter.max(), model.path_noise / np.maximum(lever, 0.02))
    return best, width


def _log_density(
    evidence: SettledEvidence,
    model: HealthyModel,
    alternatives: Alternatives,
    motor: int,
    angle: FloatArray,
) -> FloatArray:
    """Return the log density of each point with `motor` held, (run, movement, node)."""
    held = model.none_held.copy()
    held[motor] = True
    nodes = angle.shape[1]
    shape = (*alternatives.base.shape[:2], nodes, *alternatives.base.shape[2:])
    base = np.broadcast_to(alternatives.base[:, :, None], shape).copy()
    base[..., motor] = angle[:, None, :, None]
    pose = model.settle(base, alternatives.direction[:, :, None], held)
    return model.log_density(evidence, alternatives, pose, held)


def _log_prior(
    evidence: SettledEvidence, model: HealthyModel, motor: int, angle: FloatArray, prior: OnsetPrior
) -> FloatArray:
    """Return log prior masses, (run, movement first affected, plateau | ramp, node).

    Each stretch has its share of the prior; within it the nodes carry the density of the angle
    times the weights of the trapezoidal rule, normalised so that no mass is lost between nodes.
    """
    origin, target = _ends(evidence, motor)
    scale = model.scatter[motor]
    low, high = _range(model, motor)
    near = prior.known_s is not None
    plateau = _student(angle[:, None] - origin[..., None], SETTLED_SCALE * scale, 4.0)
    if prior.known_s is not None:
        way = _position_at(evidence, motor, prior.known_s)
        ramp = _student(angle[:, None] - way[..., None], ON_THE_WAY_SCALE * scale, 4.0)
    else:
        ramp = _between(angle[:, None], origin[..., None], target[..., None], 4.0 * scale)
    free = -np.log(high - low)
    tied = np.stack([plateau, ramp], axis=2)
    share = 0.05 if near else prior.free
    mixed = np.logaddexp(np.log1p(-share) + tied, np.log(share) + free)
    mass = mixed + log_trapezoid_weights(angle)[:, None, None]
    mass -= log_sum(mass, axis=-1)[..., None]
    return mass + log_of(_onset_weights(evidence, motor, prior))[..., None]


def _student(error: FloatArray, scale: float, dof: float) -> FloatArray:
    constant = gammaln((dof + 1) / 2) - gammaln(dof / 2) - 0.5 * np.log(dof * np.pi) - np.log(scale)
    return constant - 0.5 * (dof + 1) * np.log1p((error / scale) ** 2 / dof)


def _between(x: FloatArray, a: FloatArray, b: FloatArray, margin: float) -> FloatArray:
    """Return the log density of being anywhere between `a` and `b`, give or take `margin`."""
    low, high = np.minimum(a, b) - margin, np.maximum(a, b) + margin
    return np.where((x >= low) & (x <= high), -np.log(high - low), -np.inf)


def _position_at(evidence: SettledEvidence, motor: int, onset_s: float) -> FloatArray:
    """Return where each ramp has come to at `onset_s`, lag counted, (run, movement) [rad]."""
    movements = evidence.movements
    origin, target = _ends(evidence, motor)
    duration = np.maximum(movements.ramp_duration[..., motor], 1e-6)
    done = np.clip((onset_s - LAG_S - movements.start) / duration, 0.0, 1.0)
    return origin + (target - origin) * np.nan_to_num(done)


def _ends(evidence: SettledEvidence, motor: int) -> tuple[FloatArray, FloatArray]:
    """Return where each ramp of `motor` begins and ends, (run, movement) [rad]; padding is 0."""
    movements = evidence.movements
    origin, target = movements.origin()[..., motor], movements.target[..., motor]
    return np.nan_to_num(origin), np.nan_to_num(target)


def _stretches(evidence: SettledEvidence, motor: int) -> tuple[FloatArray, FloatArray]:
    """Return begin and end of plateau and ramp of each movement, (run, movement, 2) [s].

    The plateau of the first movement is the time before it, from the start of the run.
    """
    start = evidence.movements.start
    reached = start + evidence.movements.ramp_duration[..., motor] + LAG_S
    plateau_begin = np.concatenate([np.zeros_like(start[:, :1]), reached[:, :-1]], axis=1)
    begin = np.stack([np.minimum(plateau_begin, start), start], axis=-1)
    return begin, np.stack([start, reached], axis=-1)


def _onset_weights(evidence: SettledEvidence, motor: int, prior: OnsetPrior) -> FloatArray:
    """Return the prior probability of each stretch, (run, movement, plateau | ramp)."""
    begin, end = _stretches(evidence, motor)
    length = np.nan_to_num(np.maximum(end - begin, 0.0))
    if prior.known_s is not None:
        inside = (begin <= prior.known_s) & (prior.known_s < end)
        none = ~inside.any(axis=(1, 2))
        inside[none, -1, 1] = True
        return inside.astype(np.float64)
    later = length.copy()
    later[:, 0] = 0.0
    total = later.sum(axis=(1, 2), keepdims=True)
    early = np.where(total > 0, prior.early, 1.0)
    weights = (1.0 - early) * later / np.where(total > 0, total, 1.0)
    weights[:, 0] = 0.5 * early[:, 0]
    return weights


def _onset_quantiles(
    evidence: SettledEvidence,
    motor: int,
    angle: FloatArray,
    posterior: FloatArray,
    known_s: float | None,
) -> FloatArray:
    """Return quantiles 5, 50, 95 % of the onset, (run, 3) [s].

    On a ramp the held angle says when; on a plateau any time is as likely; a plateau before the
    first movement means before the run.
    """
    if known_s is not None:
        return np.full((len(angle), 3), known_s)
    begin, end = _stretches(evidence, motor)
    origin, target = _ends(evidence, motor)
    travel = target - origin
    span = np.where(np.abs(travel) > 1e-6, travel, np.inf)
    done = np.clip((angle[:, None] - origin[..., None]) / span[..., None], 0.0, 1.0)
    duration = evidence.movements.ramp_duration[..., motor]
    on_ramp = begin[..., 1, None] + LAG_S + done * duration[..., None]
    on_ramp = np.maximum(on_ramp[..., None] + LAG_SPREAD_S, 0.0).reshape(*on_ramp.shape[:2], -1)
    on_ramp_weight = np.repeat(posterior[:, :, 1] / len(LAG_SPREAD_S), len(LAG_SPREAD_S), axis=-1)
    shares = np.linspace(0.05, 0.95, 10)
    on_plateau = begin[..., 0, None] + shares * (end - begin)[..., 0, None]
    on_plateau[:, 0] = 0.0
    weight = posterior.sum(axis=-1)[..., 0, None] / len(shares)
    values = np.concatenate([on_ramp, on_plateau], axis=-1)
    weights = np.concatenate([on_ramp_weight, np.broadcast_to(weight, on_plateau.shape)], axis=-1)
    values, weights = (np.nan_to_num(v.reshape(len(v), -1)) for v in (values, weights))
    return weighted_quantiles(values, weights, (0.05, 0.5, 0.95))
