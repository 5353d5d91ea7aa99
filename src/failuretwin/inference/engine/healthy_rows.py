"""A healthy robot: nothing changes in the run, or the tool picks up a load, or sets one down.

    f = G theta + H (m - m0),    H = J diag(c) h,    h = g(q, 1 kg) - g(q, 0 kg)

while the tool is loaded, with compliance c, gravity torque g, the mass m, normal about m0 with
deviation m0, and compliance columns J diag(g + m0 h) in G: what is in doubt of the compliance
counts for the load too. The usual mass m0 weighs on the joints as much as the links do.

Section: docs/inference.md#hypotheses
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin.core.numerics import log_of
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.digital_model.settling import loads_in_range
from failuretwin.inference.engine.outcomes import Outcomes
from failuretwin.inference.engine.rows import Rows, Scene, arrived
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.registered import REGISTRATION

LEAST_SHOWN = 0.25
"""A usual load that moves the tool by less than this share of its scatter is left out."""


def healthy_rows(scene: Scene) -> Rows:
    """Return the rows of a healthy robot: no change of load, then of each change; see `changes`."""
    weight = scene.moments.log_weight[:, None]
    runs, count, channels = scene.moments.point.shape
    usual = Rows(
        np.zeros((runs, 1)),
        np.array([count]),
        scene.healthy.with_rows(),
        weight,
        np.arange(weight.shape[-1]),
        scene.columns[:, None, :, 0],
        scene.columns_of,
        np.zeros((runs, 1, count, channels)),
        np.zeros((runs, 1)),
        np.zeros((runs, 1)),
    )
    rate = scene.priors.load_changes
    mass = usual_mass_kg(scene.model) if rate > 0.0 and count > 1 else 0.0
    if mass == 0.0:
        return usual
    by_kg, lever = _load_levers(scene)
    shown = mass**2 * np.sum(lever[:, :, 0] ** 2, axis=-1)
    told = shown > LEAST_SHOWN**2 * np.einsum("rmcc->rm", scene.healthy.scatter[:, :, 0])
    log_prior = _log_prior(rate, told, scene.moments.usable)
    if not np.isfinite(log_prior[:, 1:]).any():
        return usual
    return _with_loads(usual, scene, log_prior, mass, (by_kg, lever))


def changes(count: int) -> BoolArray:
    """Return the moments at which the tool is loaded, (row, moment).

    In the first row never; in the others from a moment on, then until one.
    """
    since = np.arange(count) >= np.arange(1, count)[:, None]
    return np.concatenate([np.zeros((1, count), dtype=bool), since, ~since])


def usual_mass_kg(model: HealthyModel) -> float:
    """Return the mass that loads the joints as much as the links do, over the range [kg]; 0: none.

    Both by the norm of the gravity torques of all joints.
    """
    robot = model.twin.robot
    bare = loads_in_range(robot, 0.0)
    by_kg = np.linalg.norm(loads_in_range(robot, 1.0) - bare)
    return float(np.linalg.norm(bare) / by_kg) if by_kg > 0.0 else 0.0


def _log_prior(rate: float, told: BoolArray, usable: BoolArray) -> FloatArray:
    """Return the log prior of each row, (run, row).

    A change counts before moments that are seen; what is loaded must show a usual load.

    Args:
        rate: Probability of a change.
        told: Moments that show it, (run, moment).
        usable: Moments that are seen, same axes.
    """
    loaded = changes(told.shape[1])[1:]
    shows = ((told & usable)[:, None] & loaded).any(axis=2)
    before = np.logical_or.accumulate(usable, axis=1)[:, :-1]
    possible = shows & np.tile(usable[:, 1:] & before, 2)
    number = possible.sum(axis=1, keepdims=True)
    none = np.where(number > 0, 1.0 - rate, 1.0)
    return log_of(np.concatenate([none, possible * rate / np.maximum(number, 1)], axis=1))


def _load_levers(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Return J diag(h) and H = J diag(h) c under each outcome.

    (run, moment, outcome, channel, motor) [m N m/(rad kg)] and without the motors [m/kg].
    """
    model, (_, jacobian) = scene.model, scene.shown
    robot, bare = model.twin.robot, model.settling.payload
    pose = scene.pose * robot.sense
    torque = robot.loads.torque(pose, bare + 1.0) - robot.loads.torque(pose, bare)
    by_kg = jacobian * (robot.sense * torque)[..., None, :]
    return by_kg, np.asarray(by_kg @ np.asarray(model.settling.compliance))


def _with_loads(
    usual: Rows,
    scene: Scene,
    log_prior: FloatArray,
    mass: float,
    levers: tuple[FloatArray, FloatArray],
) -> Rows:
    """Return the rows with and without a change of load."""
    by_kg, lever = levers
    loaded = changes(scene.moments.count)
    rows = len(loaded)
    there = loaded[None, :, :, None, None]
    outcomes = usual.outcomes
    residual = outcomes.residual - np.where(there, mass * lever[:, None], 0.0)
    others = (np.broadcast_to(x, (len(x), rows, *x.shape[2:])) for x in outcomes.arrays[1:])
    motors = scene.layout.motors
    places = slice(REGISTRATION + motors, REGISTRATION + 2 * motors)

    def columns_of(run: IntArray, row: IntArray, moment: IntArray, outcome: IntArray) -> FloatArray:
        columns = scene.columns_of(run, row, moment, outcome)
        more = mass * by_kg[run, moment, outcome]
        columns[..., places] += np.where(loaded[row, moment, None, None], more, 0.0)
        return columns

    weight = usual.log_weight
    return replace(
        usual,
        log_prior=log_prior,
        first=np.full(rows, scene.moments.count),
        outcomes=Outcomes(residual, *others),
        log_weight=np.broadcast_to(weight, (len(weight), rows, *weight.shape[2:])),
        columns=arrived(columns_of, rows, scene.moments),
        columns_of=columns_of,
        lever=np.where(there[..., 0], lever[:, None, :, 0], 0.0),
        centre=np.broadcast_to(np.where(np.arange(rows) > 0, mass, 0.0), log_prior.shape),
        variance=np.broadcast_to(np.where(np.arange(rows) > 0, mass**2, 0.0), log_prior.shape),
    )
