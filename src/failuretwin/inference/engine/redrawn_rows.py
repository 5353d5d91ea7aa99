"""A fault whose size every movement draws anew: a steady-state error.

The outcomes of a moment are nodes over the size with both signs, each widened by half the distance
to the next; beside a lost command of another motor the error counts as normal. Each range of sizes
is a row, and each later onset one with any range. An error from before the run may also be the same
all along, and one that begins on a curve, which is one movement, stay as it is: rows of its size.

Section: docs/inference.md#hypotheses
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin.core.numerics import log_of
from failuretwin.core.types import FloatArray
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.inference.engine.offset_rows import constant_rows, movement_intervals
from failuretwin.inference.engine.outcomes import Outcomes
from failuretwin.inference.engine.rows import Drawn, Rows, Scene, sampled
from failuretwin.inference.faults.priors import shares_above

NODES, DECADE = 16, 8
"""Nodes of the size on each side of zero, in a constant ratio: at least, and in a factor of 10."""
CONSTANT = 0.5
"""Share of the errors that begin on a curve and then stay as they are; assumed."""
ALL_ALONG, ODD_ZERO = 0.2, 2.0
"""Share of the errors from before the run that are the same all along, and by how many deviations
of the zero of a motor they are off at least: a smaller one is another zero; assumed."""
SMALLEST = 1e-2
"""Smallest node, as a share of the largest size, where sizes begin at nothing, or at what shows
only once the noise of the sensor is found."""


def redrawn_rows(scene: Scene, motor: int, mode: FaultMode, all_along: bool) -> Rows:
    """Return the rows of a motor whose error is drawn anew for each movement.

    Args:
        scene: The runs.
        motor: Index of the motor.
        mode: Its mode.
        all_along: Whether an error that is there all along counts; false where a hypothesis of its
            own says so. It never does where somebody says how large errors are: they are drawn.
    """
    moments, model = scene.moments, scene.model
    sizes = scene.priors.sizes_of(mode, model, motor)
    low, high = sizes.ends
    smallest = low if low > 0.0 and model.noise_is_found else max(low, SMALLEST * high)
    count = max(NODES, round(DECADE * np.log10(high / smallest)))
    edge = np.geomspace(smallest, high, count + 1)
    node, width = np.sqrt(edge[1:] * edge[:-1]), np.diff(edge)
    size, width = np.r_[-node[::-1], node], np.r_[width[::-1], width]
    mass = np.stack([_mass(edge, *ends) for ends in sizes.ranges])  # (range, node)
    shares = np.array(sizes.shares)
    mass = np.concatenate([mass, shares[None] @ mass])  # and any range
    squares, fourths = mass @ size**2, mass @ size**4
    mean_square, fourth = float(squares[-1]), float(fourths[-1])
    nodes = _nodes(scene, motor, size, width)
    outcomes = Outcomes.joined(
        scene.healthy, nodes, _beside_losses(scene, motor, mean_square, fourth)
    )
    weight = _weights(scene, mass)
    faulty, any_range = weight[:, :-1], weight[:, -1]
    count, usual = moments.count, moments.log_weight.shape[-1]
    sound = np.full_like(any_range, -np.inf)
    sound[..., :usual] = moments.log_weight
    later = [np.where((np.arange(count) < m)[:, None], sound, any_range) for m in range(1, count)]
    weight = np.concatenate([faulty, np.stack(later, axis=1)], axis=1) if later else faulty
    intervals = movement_intervals(scene)
    early = scene.priors.onset.before_run(mode.mode)
    onset = intervals.weights(early)
    of_run = shares_above(sizes, scene.off_on_the_way(motor))
    log_prior = np.concatenate([log_of(onset[:, :1]) + log_of(of_run), log_of(onset[:, 1:])], 1)
    first = np.r_[np.zeros(len(shares), dtype=np.int64), np.arange(1, count)]
    runs, rows = log_prior.shape
    of_row = np.minimum(np.arange(rows), len(shares))
    samples, share = intervals.samples(early)
    nothing = np.zeros((runs, rows))
    redrawn = Rows(
        log_prior,
        first,
        outcomes.with_rows(),
        weight,
        np.r_[np.arange(usual), np.zeros(len(size), dtype=np.int64), np.arange(1, usual)],
        scene.columns[:, None, :, 0],
        scene.columns_of,
        np.zeros((runs, rows, count, moments.point.shape[-1])),
        nothing,
        nothing,
        drawn=Drawn(
            np.r_[np.full(usual, np.nan), size, np.zeros(usual - 1)],
            np.r_[np.zeros(usual), width, np.full(usual - 1, np.sqrt(12.0 * mean_square))],
            _levers(scene, motor, size, nodes.residual),
            np.stack([squares, fourths - squares**2], axis=1)[of_row],
        ),
        onsets=sampled(samples[:, first], share[:, first]),
    )
    stays = np.zeros((runs, count))
    stays[moments.on_curves.any(axis=1), 1:] = CONSTANT
    stays[:, 0] = ALL_ALONG * (all_along and sizes.visible)
    log_prior += log_of(1.0 - stays[:, first])
    parts = [
        (sizes.above(ODD_ZERO * scene.zeros[motor]), np.arange(1)),
        (sizes, np.arange(1, count)),
    ]
    for some, begins in parts:
        if stays[:, begins].any():
            constant = constant_rows(scene, motor, some, early, begins)
            log_stays = log_of(stays[:, begins])
            redrawn = redrawn.beside(replace(constant, log_prior=constant.log_prior + log_stays))
    return redrawn


def _mass(edge: FloatArray, low: float, high: float) -> FloatArray:
    """Return the share of a range of sizes in each node of both signs, (node,)."""
    mass = np.clip(np.minimum(edge[1:], high) - np.maximum(edge[:-1], low), 0.0, None)
    return np.r_[mass[::-1], mass] / max(2.0 * float(mass.sum()), 1e-300)


def _nodes(scene: Scene, motor: int, size: FloatArray, width: FloatArray) -> Outcomes:
    """Return the outcomes of all nodes if the commands of all motors arrive."""
    moments, model = scene.moments, scene.model
    base = np.repeat(moments.base[:, :, :1], len(size), axis=2)
    base[..., motor] += size * moments.done[:, :, None, motor]
    direction = np.broadcast_to(moments.direction[:, :, :1], base.shape)
    late, beside = (
        np.repeat(values[:, :, :1], len(size), axis=2) for values in (moments.late, moments.bent)
    )
    beside[..., motor] += width**2 / 12.0
    pose = model.settle(base, direction, model.none_held)
    return Outcomes.of_poses(moments, model.sensors.expected(pose), model.scatter**2, late, beside)


def _levers(scene: Scene, motor: int, size: FloatArray, residual: FloatArray) -> FloatArray:
    """Return what the sensors show of a size, (run, moment, outcome, channel) [m per unit].

    Args:
        scene: The runs.
        motor: Index of the motor.
        size: Of each node, (node,).
        residual: What was seen less what each node shows, (run, moment, node, channel) [m].
    """
    half = len(size) // 2
    sides = (slice(0, half), slice(half, None))
    slopes = [-np.gradient(residual[:, :, side], size[side], axis=2) for side in sides]
    usual = scene.shown[1][..., motor] * scene.moments.done[:, :, None, None, motor]
    return np.concatenate([usual, *slopes, usual[:, :, 1:]], axis=2)


def _beside_losses(scene: Scene, motor: int, mean_square: float, fourth: float) -> Outcomes:
    """Return the outcomes in which commands get lost, with an error x of moments E x^2 and E x^4.

        tool = y(q) + J x + c x^2 / E x^2,    c = (y(q + rms) + y(q - rms)) / 2 - y(q)

    A motor moves the tool on a circle: J alone is millimetres off for errors of some degrees.
    """
    moments, model = scene.moments, scene.model
    late, beside = moments.late[:, :, 1:], moments.bent[:, :, 1:]
    beside[..., motor] += mean_square
    pose = scene.pose[:, :, 1:]
    middle, jacobian = (values[:, :, 1:] for values in scene.shown)
    found = Outcomes.of_poses(moments, (middle, jacobian), model.scatter**2, late, beside)
    off = np.zeros_like(pose)
    off[..., motor] = np.sqrt(mean_square) * moments.done[:, :, None, motor]
    above, below = (model.sensors.expected(pose + step)[0] for step in (off, -off))
    bend = 0.5 * (above + below) - middle
    spread = (fourth / mean_square**2 - 1.0) * bend[..., :, None] * bend[..., None, :]
    return replace(found, residual=found.residual - bend, beside=found.beside + spread)


def _weights(scene: Scene, masses: FloatArray) -> FloatArray:
    """Return the log weight of each outcome, (run, row, moment, outcome)."""
    usual = scene.moments.log_weight
    never = np.full_like(usual, -np.inf)
    return np.stack(
        [
            np.concatenate([never, usual[..., :1] + log_of(mass), usual[..., 1:]], axis=-1)
            for mass in masses
        ],
        axis=1,
    )
