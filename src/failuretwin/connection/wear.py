"""Slow change of healthy motors: how fast and how far it may go, and a Kalman filter after it.

Wear is one vector for a robot: the bias of every motor [rad], then its compliance [rad/(N m)].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from failuretwin.connection.run_evidence import LEAST_SCATTER_RAD, RunEvidence
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.imperfections import Variation
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, largest_load

START = 1.0
"""Standard deviation of bias and largest sag of a robot whose calibration states no doubt, in
scatters; assumed."""
UNLOADED_NM = 1e-6
"""A motor that never carries more torque than this [N m] does not sag."""
ROUNDS = 8
"""Rounds of weights and fit; errors of a few scatters settle in half as many."""


@dataclass(frozen=True)
class WearLimits:
    """How fast and how far a healthy motor may change, in scatters of the motor.

    The same figures hold for its bias and for its sag at the largest load. No long records of a
    real arm exist, so they are assumed: on the ArmPi FPV, where a scatter is 1 to 1.7 counts, the
    tracker follows swings of a count in some hundred runs, as of temperature, and wear of some
    counts in all.

    Attributes:
        rate: Random walk from run to run, its standard deviation [per root run].
        reach: How far the latest runs may lie off the tracked state, beyond chance: more is a
            fault that grows, not wear.
        limit: How far the state may go from the calibration; beyond that, calibrate again.
        horizon: The doubt about wear grows for this many runs without learning, and no longer.
    """

    rate: float = 0.025
    reach: float = 0.5
    limit: float = 4.0
    horizon: int = 200


@dataclass(frozen=True)
class WearState:
    """What is known of the wear of a robot.

    Attributes:
        mean: (2 motor,).
        covariance: (2 motor, 2 motor).
    """

    mean: FloatArray
    covariance: FloatArray

    @property
    def deviation(self) -> FloatArray:
        """Standard deviation of each entry, (2 motor,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def blurred(self, variance: FloatArray) -> WearState:
        """Return the state after wear of a random walk of that variance, (2 motor,)."""
        return WearState(self.mean, self.covariance + np.diag(variance))


def wear_unit(robot: Robot, settling: Settling) -> FloatArray:
    """Return the wear that moves a motor by its scatter, at its largest load, (2 motor,).

    It is 0 for the compliance of a motor that gravity does not load.
    """
    load = largest_load(robot, settling.payload)
    scatter = np.maximum(settling.scatter, LEAST_SCATTER_RAD)
    sag = np.divide(scatter, load, out=np.zeros_like(load), where=load > UNLOADED_NM)
    return np.concatenate([scatter, sag])


def calibrated_state(settling: Settling, doubt: Variation | None, unit: FloatArray) -> WearState:
    """Return what a calibration knows of the wear.

    Args:
        settling: Where motors settle.
        doubt: How far that may be off; None: not stated.
        unit: Wear that moves a motor by its scatter, (2 motor,).
    """
    bias, sag = np.split(START * unit, 2)
    if doubt is not None and doubt.bias:
        bias = np.asarray(doubt.bias)
    if doubt is not None and doubt.compliance:
        sag = np.abs(settling.compliance) * doubt.compliance
    mean = np.concatenate([settling.bias, settling.compliance])
    return WearState(mean, np.diag(np.concatenate([bias, sag]) ** 2))


def worn_settling(settling: Settling, state: WearState, runs: int) -> Settling:
    """Return the settling of a calibration with the wear of a state, tracked over some runs."""
    bias, compliance = np.split(state.mean, 2)
    return replace(
        settling,
        bias=tuple(bias.tolist()),
        compliance=tuple(compliance.tolist()),
        source=f"{settling.source}; tracked over {runs} runs",
    )


def worn_variation(calibrated: Variation | None, state: WearState) -> Variation:
    """Return the doubt of a calibration with that about the wear in place of its own."""
    bias, compliance = np.split(state.deviation, 2)
    size = np.abs(np.split(state.mean, 2)[1])
    # A compliance that may be nil has no share to vary by.
    share = np.divide(compliance, size, out=np.zeros_like(size), where=size > compliance)
    return replace(
        calibrated or Variation(), bias=tuple(bias.tolist()), compliance=tuple(share.tolist())
    )


def learn(state: WearState, evidence: RunEvidence, dof: float) -> WearState:
    """Return the state after a run: a Kalman update with Student t weights.

    The mean is that of the posterior mode, found by weighting again and again; the covariance that
    of the expected information. With infinite degrees of freedom it is the Kalman filter.

    Args:
        state: Before the run.
        evidence: What the run says.
        dof: Degrees of freedom of the scatter.
    """
    size = evidence.error.size
    if size == 0:
        return state
    axes = evidence.error.shape[1]
    design, error = evidence.design.reshape(size, -1), evidence.error.reshape(size)
    cross = state.covariance @ design.T
    spread = design @ cross
    innovation, mean = error - design @ state.mean, state.mean
    for _ in range(ROUNDS):
        weight = weights((error - design @ mean).reshape(-1, axes), dof)
        mean = state.mean + cross @ np.linalg.solve(spread + np.diag(1.0 / weight), innovation)
        if np.isinf(dof):
            break
    known = np.eye(size) / information(axes, dof)
    covariance = state.covariance - cross @ np.linalg.solve(spread + known, cross.T)
    return WearState(mean, 0.5 * (covariance + covariance.T))


def weights(residual: FloatArray, dof: float) -> FloatArray:
    """Return the weight of each entry of residuals (group, axis), flat: 1 near, 0 far off."""
    axes = residual.shape[1]
    if np.isinf(dof):
        return np.ones(residual.size)
    return np.repeat((dof + axes) / (dof + np.sum(residual**2, axis=1)), axes)


def information(axes: int, dof: float) -> float:
    """Return the Fisher information of a Student t about its place, of a normal one: 1.

    Lange, Little & Taylor, JASA 84 (1989) 881: (dof + axes) / (dof + axes + 2).
    """
    return 1.0 if np.isinf(dof) else (dof + axes) / (dof + axes + 2.0)
