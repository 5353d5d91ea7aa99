"""From a fault mode to its fault model: nodes over what is unknown, and where each puts the motor.

The mode itself says where the motor settles, or how its way changes; what remains is to place
nodes where the movements point, and to give each its prior.

    phi(z) = where it settles + settled_offset(z)    weights of z: prior mass nearest to it

Section: docs/inference.md#hypotheses
"""

from __future__ import annotations

import numpy as np

from failuretwin.core.numerics import log_of, log_sum, weighted_quantiles
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.settling import sag
from failuretwin.failure_behavior.fault import Arrival
from failuretwin.failure_behavior.mode import FaultMode, Signature
from failuretwin.inference.faults.fault_sizes import SizePrior, redrawn_nodes, size_nodes
from failuretwin.inference.faults.marginal import FaultModel
from failuretwin.inference.faults.priors import immediate, next_movement
from failuretwin.inference.movements.joint_likelihood import JointLikelihood
from failuretwin.inference.movements.run_likelihood import RunLikelihood


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
    likelihood: RunLikelihood,
    motor: int,
    mode: FaultMode,
    sizes: SizePrior,
    prior_before_run: float,
) -> FaultModel:
    """Return the fault model of a fault whose offset is decided by one size, from its onset on.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: Its mode.
        sizes: What is believed of the size.
        prior_before_run: Probability that the fault was there before the run.
    """
    profile = likelihood.profile(motor)
    arrival = _arrival(likelihood, motor, mode, np.array(LONG_S))
    gain = _gain(mode, arrival)
    best, width = _best_sizes(mode, profile, gain[..., 0])
    usable = profile.usable & (np.abs(gain[..., 0]) > 1e-9)
    size, log_size = size_nodes(best, width, usable, sizes.ranges, mode.signed)
    log_size = log_sum(log_size + sizes.log_share[:, None], axis=1)
    stretches = immediate(likelihood.evidence)
    return FaultModel(
        motor=motor,
        held=False,
        angle=profile.faulty_baseline[:, :, None] + _offset(mode, size, arrival, gain),
        log_prior=log_of(stretches.weights(prior_before_run))[..., None] + log_size[:, None],
        size=size,
        onsets=stretches.onsets(prior_before_run),
        gain=gain,
    )


def _best_sizes(
    mode: FaultMode, profile: JointLikelihood, gain: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the size that each movement points to and its deviation, (run, movement).

    Args:
        mode: The mode.
        profile: What the movements say of the motor.
        gain: Offset for each unit of amount, (run, movement) [rad].
    """
    amount, width = pointed(profile, profile.faulty_baseline[..., 0], gain)
    amount = np.clip(amount, -1e3, 1e3)
    both = mode.signed or mode.signature is Signature.REDRAWN_OFFSET
    best = mode.size_of(amount if both else np.maximum(amount, 0.0))
    return best, width / _slope(mode, best)


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
    likelihood: RunLikelihood,
    motor: int,
    mode: FaultMode,
    sizes: SizePrior,
    prior_before_run: float,
) -> FaultModel:
    """Return the fault model of a fault whose offset grows from an unknown onset on.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: Its mode.
        sizes: What is believed of the rate.
        prior_before_run: Probability that it grows from the start of the run.
    """
    middle = np.nan_to_num(0.5 * (likelihood.evidence.begin + likelihood.evidence.end))
    settled = likelihood.profile(motor).faulty_baseline
    rate, log_rate = _rates(likelihood, motor, mode, sizes, middle)
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
    likelihood: RunLikelihood,
    motor: int,
    mode: FaultMode,
    sizes: SizePrior,
    since: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return rates, sorted, and the log of their prior, (run, rate) each.

    They crowd where the movements together point if the offset grows from the start of the run.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: Its mode.
        sizes: What is believed of the rate.
        since: For how long it has grown then, (run, movement) [s].
    """
    profile = likelihood.profile(motor)
    gain = _gain(mode, _arrival(likelihood, motor, mode, since[..., None]))[..., 0]
    best, width = pointed(profile, profile.faulty_baseline[..., 0], gain)
    weight = np.where(profile.usable & (gain != 0.0), 1.0 / width**2, 0.0)
    total = weight.sum(axis=1, keepdims=True)
    some = np.asarray(total > 0.0)
    together = weighted_quantiles(best, weight, (0.5,))
    spread = 1.0 / np.sqrt(np.where(some, total, 1.0))
    rates, log_rates = size_nodes(together, spread, some, sizes.ranges, mode.signed)
    return rates, log_sum(log_rates + sizes.log_share[:, None], axis=1)


# Faults that show on the way: a motor that starts late, a motor that is slow.

TIMED_NODES = 12
"""Magnitudes to sum over."""


def transient_model(
    likelihood: RunLikelihood,
    motor: int,
    mode: FaultMode,
    sizes: SizePrior,
    prior_before_run: float,
) -> FaultModel:
    """Return the fault model of a motor that starts late or has lost speed.

    Late, it settles as a healthy one; slow, movements that follow cut it short.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: Its mode.
        sizes: What is believed of the size; all between its ends is as likely.
        prior_before_run: Probability that the fault was there before the run.
    """
    size = np.linspace(*sizes.ends, TIMED_NODES)
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


def redrawn_offset_model(
    likelihood: RunLikelihood,
    motor: int,
    mode: FaultMode,
    sizes: SizePrior,
    prior_before_run: float,
) -> FaultModel:
    """Return the fault model of a fault whose size is drawn anew for each movement.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: Its mode.
        sizes: What is believed of the size; its range holds for the run.
        prior_before_run: Probability that it was there before the run.
    """
    profile = likelihood.profile(motor)
    arrival = _arrival(likelihood, motor, mode, np.array(LONG_S))
    gain = _gain(mode, arrival)[..., 0]
    best, width = _best_sizes(mode, profile, gain)
    usable = profile.usable & (np.abs(gain) > 1e-9)
    size, log_mass = redrawn_nodes(
        best, width, usable, sizes.ranges, float(likelihood.model.scatter[motor])
    )
    stretches = next_movement(likelihood.evidence.movements)
    log_first = log_of(stretches.weights(prior_before_run))
    return FaultModel(
        motor=motor,
        held=False,
        angle=profile.faulty_baseline[:, :, None]
        + mode.settled_offset(size[..., None], _by_node(arrival)),
        log_prior=log_first[..., None] + sizes.log_share,
        size=size,
        onsets=stretches.onsets(prior_before_run),
        redrawn=log_mass,
    )
