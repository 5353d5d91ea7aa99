"""Faults whose size holds for the whole run: encoder faults, play, loss of torque.

Each puts the motor off its healthy settled angle by a known multiple of an unknown amount.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.numerics import log_of, log_sum, log_trapezoid_weights, weighted_quantiles
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.data_knowledge.failure_modes import magnitude_range
from failuretwin.digital_model.settling import sag
from failuretwin.inference.joint_likelihood import JointLikelihood
from failuretwin.inference.marginal import FaultModel
from failuretwin.inference.onset import immediate, next_movement
from failuretwin.inference.run_likelihood import RunLikelihood
from failuretwin.inference.settings import Range

# Nodes of an unknown that holds for the whole run: dense where a movement may point.

LOCAL_STEPS = np.array([-8, -5, -3.5, -2.5, -1.75, -1, -0.5, 0, 0.5, 1, 1.75, 2.5, 3.5, 5, 8.0])
"""Nodes around the value that a movement points to, in its own standard deviations."""
COARSE_NODES = 41
"""Nodes spread evenly over the range of sizes, on each side of zero."""


def nodes_around(
    best: FloatArray, width: FloatArray, usable: BoolArray, otherwise: float
) -> FloatArray:
    """Return nodes around the value that each movement points to, (run, node).

    Args:
        best: That value, (run, movement).
        width: Its standard deviation, (run, movement).
        usable: Movements that point anywhere, (run, movement).
        otherwise: What the others give.
    """
    nodes = best[..., None] + width[..., None] * LOCAL_STEPS
    return np.where(usable[..., None], nodes, otherwise).reshape(len(best), -1)


def size_nodes(
    best: FloatArray, width: FloatArray, usable: BoolArray, sizes: tuple[float, ...], signed: bool
) -> tuple[FloatArray, FloatArray]:
    """Return magnitudes of a fault, sorted, and the log of their prior, (run, node) each.

    Args:
        best: Magnitude that each movement points to, (run, movement).
        width: Its standard deviation, (run, movement).
        usable: Movements that point anywhere, (run, movement).
        sizes: Lowest and highest magnitude, all between as likely.
        signed: Whether they come with a minus too.
    """
    low, high = sizes
    grid = np.linspace(low, high, COARSE_NODES)
    if signed:
        grid = np.concatenate([-grid, grid])
    local = nodes_around(best, width, usable, low)
    coarse = np.broadcast_to(grid, (len(best), len(grid)))
    nodes = np.concatenate([local, coarse], axis=1)
    side = np.where(signed & (nodes < 0.0), -1.0, 1.0)
    nodes = np.sort(side * np.clip(side * nodes, low, high), axis=1)
    # Both sides moved together: what lies between the lowest sizes has no mass.
    mass = log_trapezoid_weights(nodes - np.sign(nodes) * low)
    return nodes, mass - log_sum(mass, axis=1)[:, None]


def pointed(
    profile: JointLikelihood, settled: FloatArray, gain: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the amount that each movement points to and its deviation, (run, movement)."""
    safe = np.where(np.abs(gain) > 1e-9, gain, 1.0)
    spread = np.sqrt(1.0 / np.maximum(profile.precision[..., 0], 1e-6) + profile.scatter**2)
    return (profile.mode[..., 0] - settled) / safe, spread / np.abs(safe)


@dataclass(frozen=True)
class Amount:
    """How the magnitude of a mode turns into the amount by which it puts a motor off.

    Attributes:
        gain: Offset of the settled angle for each unit of amount, from scene and motor:
            (run, movement, outcome) [rad].
        of_size: Amount that belongs to a magnitude.
        to_size: Magnitude that belongs to an amount.
        signed: Whether magnitudes have a sign.
    """

    gain: Callable[[RunLikelihood, int], FloatArray]
    of_size: Callable[[FloatArray], FloatArray] = lambda size: size
    to_size: Callable[[FloatArray], FloatArray] = lambda amount: amount
    signed: bool = True


def _everywhere(likelihood: RunLikelihood, motor: int) -> FloatArray:
    return np.ones(likelihood.outcomes.base.shape[:3])


def _by_angle(likelihood: RunLikelihood, motor: int) -> FloatArray:
    return np.asarray(likelihood.outcomes.base[..., motor])


def _behind(likelihood: RunLikelihood, motor: int) -> FloatArray:
    """Half of the play, against the direction of the last travel."""
    return np.asarray(-0.5 * likelihood.outcomes.direction[..., motor])


def _by_sag(likelihood: RunLikelihood, motor: int) -> FloatArray:
    model, outcomes = likelihood.model, likelihood.outcomes
    pose = model.settle(outcomes.base, outcomes.direction, model.none_held)
    settling = model.settling
    yielding = sag(model.twin.robot, pose, np.asarray(settling.compliance), settling.payload)
    return np.asarray(yielding[..., motor])


AMOUNTS: Mapping[str, Amount] = {
    "encoder_bias": Amount(_everywhere),
    "encoder_scale": Amount(_by_angle),
    "backlash": Amount(_behind, signed=False),
    "torque_loss": Amount(
        _by_sag,
        of_size=lambda share: share / (1.0 - share),
        to_size=lambda amount: amount / (1.0 + amount),
        signed=False,
    ),
}
"""Modes of a constant magnitude, by id."""


def constant_fault_model(
    likelihood: RunLikelihood, motor: int, mode: str, prior_before_run: float
) -> FaultModel:
    """Return the fault model of a fault whose magnitude is the same from its onset on.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: Id of the mode, one of `AMOUNTS`.
        prior_before_run: Probability that the fault was there before the run.
    """
    amount, profile = AMOUNTS[mode], likelihood.profile(motor)
    gain = amount.gain(likelihood, motor)
    settled = profile.faulty_baseline
    best, width = pointed(profile, settled[..., 0], gain[..., 0])
    best = np.clip(best, -1e3, 1e3)
    slope = _slope(amount, best)
    size, log_size = size_nodes(
        amount.to_size(np.maximum(best, 0.0)) if not amount.signed else best,
        width / slope,
        profile.usable & (np.abs(gain[..., 0]) > 1e-9),
        magnitude_range(mode),
        amount.signed,
    )
    offset = gain[:, :, None] * amount.of_size(size)[:, None, :, None]
    stretches = immediate(likelihood.evidence)
    return FaultModel(
        motor=motor,
        held=False,
        angle=settled[:, :, None] + offset,
        log_prior=log_of(stretches.weights(prior_before_run))[..., None] + log_size[:, None],
        size=size,
        onsets=stretches.onsets(prior_before_run),
        gain=gain,
    )


def _slope(amount: Amount, at: FloatArray) -> FloatArray:
    """Return how fast the amount grows with the magnitude."""
    if amount.signed:
        return np.ones_like(at)
    size = amount.to_size(np.maximum(at, 0.0))
    step = 1e-4
    return np.asarray((amount.of_size(size + step) - amount.of_size(size)) / step)


# Drift: a motor that slips away from its targets at a constant rate, from an unknown onset on.

CELLS = 3
"""Parts of a stretch, each with one onset to sum over."""
ONSETS = (np.arange(CELLS) + 0.5) / CELLS
"""Those onsets, as shares of its length."""
WITHIN = np.linspace(-0.4, 0.4, 5) / CELLS
"""Where in its part an onset may be, beside its middle, as shares of the length of the stretch."""


def drift_model(likelihood: RunLikelihood, motor: int, prior_before_run: float) -> FaultModel:
    """Return the fault model of a motor that slips away from its targets at a constant rate.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        prior_before_run: Probability that it slips from the start of the run.
    """
    middle = np.nan_to_num(0.5 * (likelihood.evidence.begin + likelihood.evidence.end))
    settled = likelihood.profile(motor).faulty_baseline
    rate, log_rate = _rates(likelihood, motor, settled, middle)
    stretches = immediate(likelihood.evidence)
    onset, share = stretches.samples(prior_before_run, ONSETS)  # (run, movement, onset)
    log_onset = log_of(stretches.weights(prior_before_run)[..., None] * share)
    length = stretches.length[..., None] * np.ones_like(onset)
    length[..., 0] = 0.0  # before the run is no stretch of it
    runs, movements, onsets = onset.shape
    since = np.maximum(middle[:, :, None] - onset.reshape(runs, 1, -1), 0.0)
    # A node is an onset and a rate; each onset belongs to one movement that it spoils first.
    offset = (since[..., None] * rate[:, None, None]).reshape(runs, movements, -1)
    own = np.repeat(np.eye(movements), onsets, axis=1)
    log_first = log_of(own) + log_onset.reshape(runs, 1, -1)
    log_prior = (log_first[..., None] + log_rate[:, None, None]).reshape(runs, movements, -1)
    rates = rate.shape[1]

    def of_run(run: int) -> tuple[FloatArray, FloatArray]:
        at = onset[run][..., None] + length[run][..., None] * WITHIN
        return (
            np.repeat(at.reshape(1, -1, len(WITHIN)), rates, axis=1),
            np.full((1, 1, len(WITHIN)), 1.0 / len(WITHIN)),
        )

    return FaultModel(
        motor=motor,
        held=False,
        angle=settled[:, :, None] + offset[..., None],
        log_prior=log_prior,
        size=np.tile(rate, (1, movements * onsets)),
        onsets=of_run,
    )


def _rates(
    likelihood: RunLikelihood, motor: int, settled: FloatArray, since: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return rates, sorted, and the log of their prior, (run, rate) each.

    They crowd where the movements together point if the motor slips from the start of the run.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        settled: Where it settles apart from what has slipped, (run, movement, outcome) [rad].
        since: For how long it has slipped then, (run, movement) [s].
    """
    profile = likelihood.profile(motor)
    best, width = pointed(profile, settled[..., 0], since)
    weight = np.where(profile.usable & (since > 0.0), 1.0 / width**2, 0.0)
    total = weight.sum(axis=1, keepdims=True)
    some = np.asarray(total > 0.0)
    together = weighted_quantiles(best, weight, (0.5,))
    spread = 1.0 / np.sqrt(np.where(some, total, 1.0))
    return size_nodes(together, spread, some, magnitude_range("drift"), signed=True)


# Faults that show on the way: a motor that starts late, a motor that is slow.

TIMED_NODES = 12
"""Magnitudes to sum over."""


def lag_model(likelihood: RunLikelihood, motor: int, prior_before_run: float) -> FaultModel:
    """Return the fault model of a motor that is late but settles as a healthy one.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        prior_before_run: Probability that the fault was there before the run.
    """
    delay = np.linspace(*magnitude_range("lag"), TIMED_NODES)
    way = None
    if likelihood.transients is not None:
        way = likelihood.transients.delayed_or_slow(motor, np.ones(TIMED_NODES), delay)
    angle = likelihood.profile(motor).expected[:, :, None]
    return _law(
        likelihood, motor, delay, np.repeat(angle, TIMED_NODES, axis=2), way, prior_before_run
    )


def slow_model(likelihood: RunLikelihood, motor: int, prior_before_run: float) -> FaultModel:
    """Return the fault model of a motor that has lost speed; movements that follow cut it short.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        prior_before_run: Probability that the fault was there before the run.
    """
    share = np.linspace(*magnitude_range("slow"), TIMED_NODES)
    factor = 1.0 / (1.0 - share)
    begin, end = _reached(likelihood, motor, factor)
    way = None
    if likelihood.transients is not None:
        way = likelihood.transients.delayed_or_slow(motor, factor, np.zeros(TIMED_NODES), begin)
    short = end - np.nan_to_num(likelihood.evidence.movements.target[..., motor])[..., None]
    angle = likelihood.profile(motor).expected[:, :, None] + short[..., None]
    return _law(likelihood, motor, share, angle, way, prior_before_run)


def _law(
    likelihood: RunLikelihood,
    motor: int,
    size: FloatArray,
    angle: FloatArray,
    way: FloatArray | None,
    prior_before_run: float,
) -> FaultModel:
    stretches = next_movement(likelihood.evidence.movements)
    log_first = log_of(stretches.weights(prior_before_run)) - np.log(TIMED_NODES)
    return FaultModel(
        motor=motor,
        held=False,
        angle=angle,
        log_prior=np.repeat(log_first[..., None], TIMED_NODES, axis=2),
        size=size[None],
        onsets=stretches.onsets(prior_before_run),
        log_transient=way,
    )


def _reached(
    likelihood: RunLikelihood, motor: int, factor: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return where a slow motor begins and ends each movement, (run, movement, node) [rad]."""
    movements = likelihood.evidence.movements
    target = np.nan_to_num(movements.target[..., motor])[..., None]
    needed = np.nan_to_num(movements.ramp_duration[..., motor])[..., None] * factor
    available = (likelihood.evidence.end - movements.start)[..., None]
    done = np.divide(available, needed, out=np.ones_like(needed), where=needed > 0.0)
    done = np.clip(np.nan_to_num(done, nan=1.0), 0.0, 1.0)
    here = np.repeat(movements.initial[:, motor, None], len(factor), axis=1)
    begin, end = np.empty_like(needed), np.empty_like(needed)
    for m in range(target.shape[1]):
        begin[:, m] = here
        here = here + (target[:, m] - here) * done[:, m]
        end[:, m] = here
    return begin, end


# A steady-state error: an unknown offset from the target, drawn anew for each movement.

ERROR_NODES = 36
"""Sizes to sum over on each side of zero, up to the largest error considered."""


def steady_state_error_model(
    likelihood: RunLikelihood, motor: int, ranges: Sequence[Range], prior_before_run: float
) -> FaultModel:
    """Return the fault model of `motor` having a steady-state error.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        ranges: Run-level ranges of the error's size [rad], equally likely.
        prior_before_run: Probability that it was there before the run.
    """
    offset, log_weight = offset_nodes(ranges)
    stretches = next_movement(likelihood.evidence.movements)
    log_first = log_of(stretches.weights(prior_before_run))
    return FaultModel(
        motor=motor,
        held=False,
        angle=likelihood.profile(motor).faulty_baseline[:, :, None] + offset[:, None],
        log_prior=np.repeat(log_first[..., None] - np.log(len(ranges)), len(ranges), axis=2),
        size=offset[None],
        onsets=stretches.onsets(prior_before_run),
        redrawn=log_weight,
    )


def offset_nodes(ranges: Sequence[Range]) -> tuple[FloatArray, FloatArray]:
    """Return signed sizes (node,) [rad] and their log weights in each range (range, node)."""
    largest = max(high for _, high in ranges)
    smallest = min(low for low, _ in ranges)
    step = (largest - smallest) / (ERROR_NODES - 1) if largest > smallest else 0.0
    sizes = smallest + step * np.arange(ERROR_NODES if step else 1)
    edges = np.concatenate([[smallest], 0.5 * (sizes[1:] + sizes[:-1]), [largest]])
    weights = []
    for low, high in ranges:
        overlap = np.clip(np.minimum(edges[1:], high) - np.maximum(edges[:-1], low), 0.0, None)
        total = overlap.sum()
        weights.append(overlap / total if total else np.eye(1, len(sizes))[0])
    half = 0.5 * np.array(weights)
    return np.concatenate([-sizes, sizes]), log_of(np.concatenate([half, half], axis=1))
