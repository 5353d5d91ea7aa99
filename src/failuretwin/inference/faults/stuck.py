"""A stuck motor: one unknown angle after an unknown onset.

The onset falls in one of two intervals for each movement: on the plateau before it (the motor
then stands where it had settled) or on its ramp (it stands somewhere on the way). From there on
the motor keeps its angle and the others behave as healthy ones.

    p(phi | m0) = 0.8 p(phi | where the motor was then) + 0.2 / range,    L_m(phi) of a held motor

(0.95 and 0.05 where the onset is known).

Section: docs/inference.md#hypotheses
"""

from __future__ import annotations

import math

import numpy as np

from failuretwin.core.compiled import compiled
from failuretwin.core.numerics import log_of, log_sum
from failuretwin.core.types import FloatArray
from failuretwin.inference.faults.fault_sizes import nodes_around
from failuretwin.inference.faults.marginal import FaultModel
from failuretwin.inference.faults.priors import OnsetIntervals, OnsetPrior, plateau_or_ramp
from failuretwin.inference.movements.joint_likelihood import JointLikelihood
from failuretwin.inference.movements.run_likelihood import RunLikelihood

COARSE_NODES = 49
"""Nodes spread evenly over the range of the held angle, of the usual width; more over a wider."""
FULL_TURN = 2.0 * np.pi
PRIOR_STEPS = np.array([-5, -2.5, -1, 0, 1, 2.5, 5.0])
"""Nodes around each angle that the prior favours, in the scale of its peak."""
SETTLED_SCALE, ON_THE_WAY_SCALE = 2.0, 8.0
"""How sharply the prior ties the held angle to where the motor had settled, and to where its ramp
was at a known onset, in scatters of the motor: scales of a Student t of four degrees of freedom,
p(x) = 3/8 (1 + x^2 / 4)^(-5/2)."""
MARGIN = 4.0
"""How far beyond the ends of its ramp a motor may stick on it, in its scatters."""
FREE_IF_KNOWN = 0.05
"""Probability that the held angle is unrelated to the commands where the onset is known."""


def stuck_model(
    likelihood: RunLikelihood, motor: int, prior: OnsetPrior, likely: FloatArray | None = None
) -> FaultModel:
    """Return the fault model of `motor` being stuck.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        prior: When and where it may have got stuck.
        likely: Angles to integrate over besides those that movements point to if this motor alone
            is faulty, (run, node) [rad].
    """
    angle = _angle_nodes(likelihood, motor, prior)
    if likely is not None:
        low, high = (end[:, None] for end in likelihood.held_range(motor))
        angle = np.sort(np.concatenate([angle, likely.clip(low, high)], axis=1))
    parts = _log_prior(likelihood, motor, angle, prior)  # (run, movement, plateau | ramp, node)
    log_prior = log_sum(parts, axis=2)

    def of_run(run: int) -> tuple[FloatArray, FloatArray]:
        by_part = _onsets(likelihood[run], motor, angle[run])
        whole = np.where(np.isfinite(log_prior[run]), log_prior[run], 0.0)
        of_part = np.exp(parts[run] - whole[:, None])
        onset = np.concatenate([onset for onset, _ in by_part], axis=-1)
        if prior.known_s is not None:
            onset = np.full_like(onset, prior.known_s)
        shares = [of_part[:, k, :, None] * share for k, (_, share) in enumerate(by_part)]
        return onset, np.concatenate(shares, axis=-1)

    return FaultModel(
        motor=motor,
        held=True,
        angle=angle[:, None, :, None],
        log_prior=log_prior,
        size=angle,
        onsets=of_run,
        log_transient=likelihood.log_transient_stuck(motor, angle),
    )


def _angle_nodes(likelihood: RunLikelihood, motor: int, prior: OnsetPrior) -> FloatArray:
    """Return angles to integrate over, sorted, (run, node) [rad].

    They crowd where the likelihood or the prior may have a peak.
    """
    low, high = (end[:, None] for end in likelihood.held_range(motor))
    profile = likelihood.profile(motor)
    runs = len(profile.mode)
    width = np.sqrt(1.0 / np.maximum(profile.precision[..., 0], 1.0) + 1e-10)
    local = _around_copies(profile, width, low, high)
    coarse = np.linspace(low[:, 0], high[:, 0], likelihood.spread_over(motor, COARSE_NODES), axis=1)
    origin, _ = _ends(likelihood, motor)
    scale = max(profile.scatter, 1e-4)
    tied = [origin[..., None] + SETTLED_SCALE * scale * PRIOR_STEPS]
    if prior.known_s is not None:
        way = _position_at(likelihood, motor, prior.known_s)
        tied.append(way[..., None] + ON_THE_WAY_SCALE * scale * PRIOR_STEPS)
    # Padded movements favour no angle, so that a run is judged as it is on its own.
    there = likelihood.evidence.movements.exists[..., None]
    peaks = [np.where(there, angles, low[..., None]).reshape(runs, -1) for angles in tied]
    nodes = [coarse, local, *peaks]
    return np.sort(np.clip(np.concatenate(nodes, axis=1), low, high), axis=1)


def _around_copies(
    profile: JointLikelihood, width: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Return nodes around the angle that each movement points to, (run, node) [rad].

    And around its copies full turns away, where they lie within the range.

    Args:
        profile: What the movements say of the motor.
        width: Standard deviation of that angle, (run, movement) [rad].
        low: Lowest held angle, (run, 1) [rad]; what points nowhere gives it.
        high: The highest.
    """
    best = profile.mode[..., 0]
    found = [nodes_around(best, width, profile.usable, low)]
    for turns in (-2, -1, 1, 2) if profile.wraps else ():
        copy = best + turns * FULL_TURN
        inside = profile.usable & (copy > low) & (copy < high)
        if inside.any():
            found.append(nodes_around(copy, width, inside, low))
    return np.concatenate(found, axis=1)


def _log_prior(
    likelihood: RunLikelihood, motor: int, angle: FloatArray, prior: OnsetPrior
) -> FloatArray:
    """Return log prior masses, (run, movement first affected, plateau | ramp, node).

    Each interval has its share of the prior.
    """
    mass = log_of(held_prior(likelihood, motor, angle, prior))
    intervals = stuck_intervals(likelihood, motor)
    if prior.known_s is not None:
        return mass + log_of(intervals.holding(prior.known_s))[..., None]
    return mass + log_of(intervals.weights(prior.before_run("stuck")))[..., None]


def held_prior(
    likelihood: RunLikelihood, motor: int, angle: FloatArray, prior: OnsetPrior
) -> FloatArray:
    """Return p(held angle | onset in an interval), (run, movement, plateau | ramp, node).

    The nodes carry the density of the angle times the weights of the trapezoidal rule, normalised
    so that no mass is lost between nodes.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        angle: Nodes, sorted, (run, node) [rad].
        prior: How closely the angle is tied to the commands.
    """
    origin, target = _ends(likelihood, motor)
    scale = max(float(likelihood.model.scatter[motor]), 1e-4)
    way = np.full_like(origin, np.nan)
    if prior.known_s is not None:
        way = _position_at(likelihood, motor, prior.known_s)
    free = FREE_IF_KNOWN if prior.known_s is not None else prior.free
    low, high = likelihood.held_range(motor)
    found = np.empty((*origin.shape, 2, angle.shape[1]))
    ends = np.stack([origin, target, way])
    _write_held_prior(np.ascontiguousarray(angle), ends, high - low, scale, free, found)
    return found


@compiled
def _write_held_prior(
    angle: FloatArray,
    ends: FloatArray,
    width: FloatArray,
    scale: float,
    free: float,
    found: FloatArray,
) -> None:
    """Write `held_prior`; where the place on the way is not known, any on it is as likely.

    Ends of the ramps and the place between them where the motor stuck are (3, run, movement) [rad],
    the range of held angles (run,) [rad], the scatter a scale [rad].
    """
    runs, movements, _, nodes = found.shape
    for r in range(runs):
        for m in range(movements):
            origin, target, way = ends[0, r, m], ends[1, r, m], ends[2, r, m]
            low, high = min(origin, target) - MARGIN * scale, max(origin, target) + MARGIN * scale
            for part in range(2):
                ramp = part == 1 and math.isnan(way)
                centre = way if part == 1 else origin
                unit = scale * (ON_THE_WAY_SCALE if part == 1 else SETTLED_SCALE)
                total = 0.0
                for n in range(nodes):
                    phi = angle[r, n]
                    if ramp:
                        tied = 1.0 / (high - low) if low <= phi <= high else 0.0
                    else:
                        fall = 1.0 + 0.25 * ((phi - centre) / unit) ** 2
                        tied = 0.375 / (unit * fall * fall * math.sqrt(fall))
                    step = angle[r, min(n + 1, nodes - 1)] - angle[r, max(n - 1, 0)]
                    mass = 0.5 * step * ((1.0 - free) * tied + free / width[r])
                    found[r, m, part, n] = mass
                    total += mass
                for n in range(nodes):
                    found[r, m, part, n] /= total


def _position_at(likelihood: RunLikelihood, motor: int, onset_s: float) -> FloatArray:
    """Return where each ramp has come to at `onset_s`, lag counted, (run, movement) [rad]."""
    movements = likelihood.evidence.movements
    origin, target = _ends(likelihood, motor)
    duration = np.maximum(movements.ramp_duration[..., motor], 1e-6)
    done = np.clip((onset_s - likelihood.model.lag_s - movements.start) / duration, 0.0, 1.0)
    return origin + (target - origin) * np.nan_to_num(done)


def _ends(likelihood: RunLikelihood, motor: int) -> tuple[FloatArray, FloatArray]:
    """Return where each ramp of `motor` begins and ends, (run, movement) [rad]; padding is 0.

    These are the angles at which it settles, off its targets as it is when healthy.
    """
    movements = likelihood.evidence.movements
    settled = likelihood.profile(motor).expected[..., 0]
    off = np.nan_to_num(settled - movements.target[..., motor])
    at_first = likelihood.start[:, motor] - movements.initial[:, motor]
    before = np.concatenate([at_first[:, None], off[:, :-1]], axis=1)
    return np.nan_to_num(movements.origin()[..., motor]) + before, np.nan_to_num(settled)


def stuck_intervals(likelihood: RunLikelihood, motor: int) -> OnsetIntervals:
    """Return plateau and ramp of each movement, (run, movement, plateau | ramp) [s].

    Movements that are likely to have started late count as begun by so much later.
    """
    movements, model = likelihood.evidence.movements, likelihood.model
    late_s = float(np.mean(model.imperfections.timing.late_s))
    start = movements.start + model.lag_s + likelihood.late * late_s
    ramp = movements.ramp_duration[..., motor] * (1.0 - model.shortening)
    return plateau_or_ramp(start, start + ramp)


LAG_DOUBT_S = 0.03
"""Standard deviation of one motor's lag about the mean lag of the robot [s]: loads, gains and the
clocks of sensors differ, and healthy logs tell the mean alone; half of the mean lag of the ArmPi
FPV, assumed. It widens the interval of the onset; no probability depends on it."""
LAG_STEPS = np.linspace(-2.0, 2.0, 9)
"""Lags to sum over, in that deviation."""
LAG_SHARES = np.exp(-0.5 * LAG_STEPS**2) / np.exp(-0.5 * LAG_STEPS**2).sum()
"""How probable each is."""


def _onsets(
    likelihood: RunLikelihood, motor: int, angle: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Return onsets of one run [s] and their share, (movement, node, sample): plateau, then ramp.

    On the plateau any time is as likely; before the first movement that is before the run, or, with
    its share of the run's length, until then. On the ramp the held angle says when.

    Args:
        likelihood: A single run.
        motor: Index of the motor.
        angle: Held angles, (node,) [rad].
    """
    movements, model = likelihood.evidence.movements, likelihood.model
    intervals = stuck_intervals(likelihood, motor)
    plateau = OnsetIntervals(intervals.begin[..., 0], intervals.end[..., 0])
    end = np.nan_to_num(intervals.end)
    waits = end[:, 0, 0] / np.maximum(end.max(axis=(1, 2)), 1e-9)
    waiting = [values[0, :, None] for values in plateau.spread(1.0 - waits)]
    origin, target = (x[0] for x in _ends(likelihood, motor))
    travel = target - origin
    span = np.where(np.abs(travel) > 1e-6, travel, np.inf)
    done = np.clip((angle - origin[:, None]) / span[:, None], 0.0, 1.0)
    ramp = np.nan_to_num(movements.ramp_duration[0, :, motor]) * (1.0 - model.shortening)
    reached = np.nan_to_num(movements.start[0])[:, None] + done * ramp[:, None]
    delay, chance = model.start_delay.nodes(likelihood.late[0])
    delay = (delay[:, None] + LAG_DOUBT_S * LAG_STEPS).ravel()
    chance = (chance[..., None] * LAG_SHARES).reshape(len(chance), -1)
    moving = [np.maximum(reached[..., None] + delay, 0.0), chance[:, None]]
    return [_for_nodes(part, len(angle)) for part in (waiting, moving)]


def _for_nodes(part: list[FloatArray], nodes: int) -> tuple[FloatArray, FloatArray]:
    """Return onsets and shares, (movement, node or 1, sample), for all of the nodes."""
    onset, share = (np.repeat(x, nodes // x.shape[1], axis=1) for x in part)
    return onset, share
