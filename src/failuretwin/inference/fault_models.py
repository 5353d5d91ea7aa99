"""From a fault mode to its fault model: nodes over what is unknown, and where each puts the motor.

The mode itself says where the motor settles, or how its way changes; what remains is to place
nodes where the movements point, and to give each its prior.

    phi(z) = where it settles + settled_offset(z)    weights of z: the trapezoidal rule

Section: docs/diagnosis.md#fault-models-where-each-fault-puts-its-motor
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from failuretwin.core.numerics import log_of, log_sum, log_trapezoid_weights, weighted_quantiles
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.settling import sag
from failuretwin.failure_behavior.fault import Arrival
from failuretwin.failure_behavior.mode import FaultMode, Range
from failuretwin.inference.joint_likelihood import JointLikelihood
from failuretwin.inference.marginal import FaultModel
from failuretwin.inference.priors import immediate, next_movement
from failuretwin.inference.run_likelihood import RunLikelihood

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


# An offset that one size decides for the whole run: encoder faults, play, loss of torque.

LONG_S = 10.0
"""A fault that does not change has been there for so long when it is asked for its offset [s]."""


def offset_model(
    likelihood: RunLikelihood, motor: int, mode: FaultMode, prior_before_run: float
) -> FaultModel:
    """Return the fault model of a fault whose offset is decided by one size, from its onset on.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: Its mode.
        prior_before_run: Probability that the fault was there before the run.
    """
    profile = likelihood.profile(motor)
    arrival = _arrival(likelihood, motor, mode, np.array(LONG_S))
    gain = _gain(mode, arrival)
    settled = profile.faulty_baseline
    amount, width = pointed(profile, settled[..., 0], gain[..., 0])
    amount = np.clip(amount, -1e3, 1e3)
    best = mode.size_of(amount if mode.signed else np.maximum(amount, 0.0))
    size, log_size = size_nodes(
        best,
        width / _slope(mode, best),
        profile.usable & (np.abs(gain[..., 0]) > 1e-9),
        mode.considered,
        mode.signed,
    )
    stretches = immediate(likelihood.evidence)
    return FaultModel(
        motor=motor,
        held=False,
        angle=settled[:, :, None] + _offset(mode, size, arrival, gain),
        log_prior=log_of(stretches.weights(prior_before_run))[..., None] + log_size[:, None],
        size=size,
        onsets=stretches.onsets(prior_before_run),
        gain=gain,
    )


def _arrival(
    likelihood: RunLikelihood, motor: int, mode: FaultMode, since_onset: FloatArray
) -> Arrival:
    """Return where a motor comes to rest, (run, movement, outcome).

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: The mode that will ask; the load counts for those that yield to it alone.
        since_onset: For how long the fault has been there [s].
    """
    model, outcomes = likelihood.model, likelihood.outcomes
    movements = likelihood.evidence.movements
    target, direction = outcomes.base[..., motor], outcomes.direction[..., motor]
    travel = np.nan_to_num(np.abs(movements.target - movements.origin())[..., motor])
    load = np.zeros(1)
    if mode.needs_compliance:
        pose = model.settle(outcomes.base, outcomes.direction, model.none_held)
        settling = model.settling
        load = sag(model.twin.robot, pose, np.asarray(settling.compliance), settling.payload)
        load = load[..., motor]
    return Arrival(target - direction * travel[..., None], target, direction, since_onset, load)


def _by_node(arrival: Arrival, axes: int = 1) -> Arrival:
    """Return the same with axes for nodes, (run, movement, 1, outcome)."""
    fields = (arrival.origin, arrival.target, arrival.direction, arrival.since_onset, arrival.sag)
    new = tuple(range(2, 2 + axes))
    return Arrival(*(np.expand_dims(x, new) if x.ndim == 3 else x for x in fields))


def _gain(mode: FaultMode, arrival: Arrival) -> FloatArray:
    """Return the offset for each unit of amount, at the smallest size above 0."""
    low, high = mode.considered
    size = np.array(low or high)
    gain = mode.settled_offset(size, arrival) / mode.amount(size)
    return np.array(np.broadcast_to(gain, arrival.target.shape))


def _offset(mode: FaultMode, size: FloatArray, arrival: Arrival, gain: FloatArray) -> FloatArray:
    """Return the offset at each node, (run, movement, node, outcome) [rad].

    Args:
        mode: The mode.
        size: Sizes, (run, node).
        arrival: Where the motor comes to rest.
        gain: Offset for each unit of amount at the smallest size; where the mode is seen to keep
            it at other sizes, that spares asking at every node.
    """
    low, high = mode.considered
    probes = low + np.array([0.31, 0.73, 1.0]) * (high - low)
    probes = np.concatenate([probes, -probes]) if mode.signed else probes
    found = [mode.settled_offset(probe, arrival) for probe in probes]
    if np.allclose(found, [gain * mode.amount(probe) for probe in probes], 1e-9, 1e-12):
        return gain[:, :, None] * mode.amount(size)[:, None, :, None]
    return mode.settled_offset(size[:, None, :, None], _by_node(arrival))


def _slope(mode: FaultMode, size: FloatArray) -> FloatArray:
    """Return how fast the amount grows with the size."""
    step = 1e-4
    return (mode.amount(size + step) - mode.amount(size)) / step


# An offset that grows with the time since the onset: drift.

CELLS = 3
"""Parts of a stretch, each with one onset to sum over."""
ONSETS = (np.arange(CELLS) + 0.5) / CELLS
"""Those onsets, as shares of its length."""
WITHIN = np.linspace(-0.4, 0.4, 5) / CELLS
"""Where in its part an onset may be, beside its middle, as shares of the length of the stretch."""


def growing_offset_model(
    likelihood: RunLikelihood, motor: int, mode: FaultMode, prior_before_run: float
) -> FaultModel:
    """Return the fault model of a fault whose offset grows from an unknown onset on.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: Its mode.
        prior_before_run: Probability that it grows from the start of the run.
    """
    middle = np.nan_to_num(0.5 * (likelihood.evidence.begin + likelihood.evidence.end))
    settled = likelihood.profile(motor).faulty_baseline
    rate, log_rate = _rates(likelihood, motor, mode, settled, middle)
    stretches = immediate(likelihood.evidence)
    onset, share = stretches.samples(prior_before_run, ONSETS)  # (run, movement, onset)
    log_onset = log_of(stretches.weights(prior_before_run)[..., None] * share)
    length = stretches.length[..., None] * np.ones_like(onset)
    length[..., 0] = 0.0  # before the run is no stretch of it
    runs, movements, onsets = onset.shape
    since = np.maximum(middle[:, :, None] - onset.reshape(runs, 1, -1), 0.0)
    # A node is an onset and a rate; each onset belongs to one movement that it spoils first.
    arrival = _arrival(likelihood, motor, mode, since[..., None, None])
    arrival = _by_node(arrival, axes=2)  # (run, movement, onset, rate, outcome)
    offset = mode.settled_offset(rate[:, None, None, :, None], arrival)
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
        angle=settled[:, :, None] + offset.reshape(*log_prior.shape, -1),
        log_prior=log_prior,
        size=np.tile(rate, (1, movements * onsets)),
        onsets=of_run,
    )


def _rates(
    likelihood: RunLikelihood, motor: int, mode: FaultMode, settled: FloatArray, since: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return rates, sorted, and the log of their prior, (run, rate) each.

    They crowd where the movements together point if the offset grows from the start of the run.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: Its mode.
        settled: Where it settles apart from what has grown, (run, movement, outcome) [rad].
        since: For how long it has grown then, (run, movement) [s].
    """
    profile = likelihood.profile(motor)
    gain = _gain(mode, _arrival(likelihood, motor, mode, since[..., None]))[..., 0]
    best, width = pointed(profile, settled[..., 0], gain)
    weight = np.where(profile.usable & (gain != 0.0), 1.0 / width**2, 0.0)
    total = weight.sum(axis=1, keepdims=True)
    some = np.asarray(total > 0.0)
    together = weighted_quantiles(best, weight, (0.5,))
    spread = 1.0 / np.sqrt(np.where(some, total, 1.0))
    return size_nodes(together, spread, some, mode.considered, mode.signed)


# Faults that show on the way: a motor that starts late, a motor that is slow.

TIMED_NODES = 12
"""Magnitudes to sum over."""


def transient_model(
    likelihood: RunLikelihood, motor: int, mode: FaultMode, prior_before_run: float
) -> FaultModel:
    """Return the fault model of a motor that starts late or has lost speed.

    Late, it settles as a healthy one; slow, movements that follow cut it short.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: Its mode.
        prior_before_run: Probability that the fault was there before the run.
    """
    size = np.linspace(*mode.considered, TIMED_NODES)
    factor, delay = mode.ramp_factor(size), mode.dead_time(size)
    angle, begin, way = likelihood.profile(motor).expected[:, :, None], None, None
    if (factor != 1.0).any():
        begin, end = _reached(likelihood, motor, factor)
        target = np.nan_to_num(likelihood.evidence.movements.target[..., motor])
        angle = angle + (end - target[..., None])[..., None]
    else:
        angle = np.repeat(angle, TIMED_NODES, axis=2)
    if likelihood.transients is not None:
        way = likelihood.transients.delayed_or_slow(motor, factor, delay, begin)
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


# An offset that is drawn anew for each movement: a steady-state error.

ERROR_NODES = 36
"""Sizes to sum over on each side of zero, up to the largest error considered."""


def redrawn_offset_model(
    likelihood: RunLikelihood,
    motor: int,
    mode: FaultMode,
    ranges: Sequence[Range],
    prior_before_run: float,
) -> FaultModel:
    """Return the fault model of a fault whose size is drawn anew for each movement.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: Its mode.
        ranges: Run-level ranges of the size, equally likely.
        prior_before_run: Probability that it was there before the run.
    """
    size, log_weight = offset_nodes(ranges)
    arrival = _by_node(_arrival(likelihood, motor, mode, np.array(LONG_S)))
    offset = mode.settled_offset(size[:, None], arrival)
    stretches = next_movement(likelihood.evidence.movements)
    log_first = log_of(stretches.weights(prior_before_run))
    return FaultModel(
        motor=motor,
        held=False,
        angle=likelihood.profile(motor).faulty_baseline[:, :, None] + offset,
        log_prior=np.repeat(log_first[..., None] - np.log(len(ranges)), len(ranges), axis=2),
        size=size[None],
        onsets=stretches.onsets(prior_before_run),
        redrawn=log_weight,
    )


def offset_nodes(ranges: Sequence[Range]) -> tuple[FloatArray, FloatArray]:
    """Return signed sizes (node,) and their log weights in each range (range, node)."""
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
