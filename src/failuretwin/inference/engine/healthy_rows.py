"""A healthy robot at rest: as it is, or with another load at its tool from some moment on.

    H = J diag(c) dg/dmass,    v = (z0 w c dg/dmass)^2

with compliances c and load torques g. The mass z that is picked up or put down is normal with
deviation z0; v is the variance of each motor, which differs by a share w of what c says.

Section: docs/inference.md#healthy-robot
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin.core.numerics import log_of
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.settling import loads_in_range, sag
from failuretwin.inference.engine.offset_rows import moment_intervals
from failuretwin.inference.engine.outcomes import seen_variance
from failuretwin.inference.engine.rows import Rows, Scene, before_onset
from failuretwin.inference.observation.healthy_model import HealthyModel

LOAD_RATE = 0.004
"""Probability that a healthy arm picks something up or puts it down within a run; assumed."""
OWN_SHARE = 0.5
"""Share by which what a motor yields to a load differs from what its compliance says; assumed."""


def healthy_rows(scene: Scene) -> Rows:
    """Return the row of a healthy robot, and those of another load from each later moment on."""
    yielding = _yielding(scene)
    if scene.layout.moving or scene.moments.count < 2 or not yielding.any():
        return scene.healthy_rows()
    return before_onset(_loaded(scene, yielding), scene.healthy, scene.columns)


def usual_load_kg(model: HealthyModel) -> float:
    """Return z0, the mass that pulls at all motors together as the links do [kg]."""
    bare, loaded = (loads_in_range(model.twin.robot, mass) for mass in (0.0, 1.0))
    return float(np.sqrt(np.mean(bare**2) / np.mean((loaded - bare) ** 2)))


def _yielding(scene: Scene) -> FloatArray:
    """Return c dg/dmass of each motor, (run, moment, motor) [rad/kg]."""
    settling, robot = scene.model.settling, scene.model.twin.robot
    bare, loaded = (
        sag(robot, scene.settled, np.asarray(settling.compliance), settling.payload + mass)
        for mass in (0.0, 1.0)
    )
    return np.asarray(loaded - bare)


def _loaded(scene: Scene, yielding: FloatArray) -> Rows:
    """Return the rows as if each load had been there from the first moment on."""
    jacobian, count = scene.shown[1], scene.moments.count
    mass, weight = usual_load_kg(scene.model), scene.moments.log_weight
    lever = np.matmul(jacobian[:, :, 0], yielding[..., None])[..., 0]
    differs = seen_variance(jacobian, (mass * OWN_SHARE * yielding[:, :, None]) ** 2)
    outcomes = replace(scene.healthy, beside=scene.healthy.beside + differs)
    log_prior = log_of(_chances(scene))
    variance = np.where(np.arange(count) > 0, mass**2, 0.0)
    return Rows(
        log_prior,
        np.r_[count, np.arange(1, count)],
        outcomes.with_rows(),
        np.repeat(weight[:, None], count, axis=1),
        np.arange(weight.shape[-1]),
        scene.columns[:, None],
        lever[:, None],
        np.zeros_like(log_prior),
        np.tile(variance, (len(log_prior), 1)),
    )


def _chances(scene: Scene) -> FloatArray:
    """Return the probability of no other load, and of one from each later moment on, (run, row)."""
    found = moment_intervals(scene).weights(0.0)
    found[:, 0] = 0.0
    found *= LOAD_RATE / np.maximum(found.sum(axis=1, keepdims=True), 1e-12)
    found[:, 0] = 1.0 - found.sum(axis=1)
    return found
