"""Slow change of healthy motors: how fast and how far it may go, and a Kalman filter after it.

Wear is one vector for a robot: the bias of every motor [rad], then its compliance [rad/(N m)].
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.connection.calibration.observations import (
    LEAST_SCATTER_RAD,
    Observations,
    SettlingRegression,
    lost_command,
)
from failuretwin.core.types import BoolArray, FloatArray, as_floats
from failuretwin.digital_model.nonidealities import Variation
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, largest_load
from failuretwin.inference.healthy_model import PATH_NOISE_M

# What one run says of the wear of the motors: a linear model with unit scatter.

DECIMALS = 6
"""Errors and designs are rounded to this many decimals of the scatter: short in a file, and a run
read back from it is the run that was written."""
KEY_DIGITS = 16


@dataclass(frozen=True)
class RunEvidence:
    """Settled errors of one run as a linear model: error = design @ wear + unit scatter.

    Wear is the bias of every motor, then its compliance. A group is what scatters together as one
    Student t: the three axes of a tool position, or the reading of one motor.

    Attributes:
        run: Name of the run.
        key: Fingerprint of its settled movements; a run given twice is known by it.
        error: Settled minus commanded, friction taken off, in scatters, (group, axis).
        design: Its slope by wear, (group, axis, 2 motor) [1/rad, then N m/rad].
    """

    run: str
    key: str
    error: FloatArray
    design: FloatArray


def run_evidence(
    observations: Observations, robot: Robot, settling: Settling, runs: Sequence[int]
) -> list[RunEvidence]:
    """Return what runs say; nothing of movements whose command did not arrive.

    Args:
        observations: Settled movements; by the motors' readings where they have them, else by the
            tool.
        robot: The robot.
        settling: Where motors settle as far as is known: the model is made linear there.
        runs: Indices of the wanted runs.
    """
    wanted = observations[np.isin(observations.run, np.asarray(runs))]
    expected = wanted.target + settling.offset(robot, wanted.target, wanted.direction)
    kept = ~lost_command(wanted, robot, expected)
    if wanted.position is None:
        kept = np.asarray(kept.all(axis=1, keepdims=True))
    everywhere = np.ones_like(wanted.target)
    regression = SettlingRegression.of(wanted, robot, everywhere, settling)
    error, design = regression.whitened(settling, PATH_NOISE_M)
    return [_of_run(wanted, error, design, kept, run) for run in runs]


def _of_run(
    seen: Observations, error: FloatArray, design: FloatArray, kept: BoolArray, run: int
) -> RunEvidence:
    inside = seen.run == run
    chosen = inside[:, None] & kept
    return RunEvidence(
        run=seen.runs[run],
        key=_key(seen[inside], seen.runs[run]),
        error=np.round(error[chosen], DECIMALS),
        design=np.round(design[chosen], DECIMALS),
    )


def _key(seen: Observations, name: str) -> str:
    """Return the fingerprint of the movements of one run."""
    digest = hashlib.sha256(name.encode())
    for values in (seen.target, seen.point):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()[:KEY_DIGITS]


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
    axes, root = evidence.error.shape[1], _root(state)
    design = evidence.design.reshape(size, -1)
    off, scaled = evidence.error.reshape(size) - design @ state.mean, design @ root
    prior, change = np.eye(len(root)), np.zeros(len(root))
    for _ in range(ROUNDS):
        weight = weights((off - scaled @ change).reshape(-1, axes), dof)[:, None]
        known = (scaled * weight).T @ scaled + prior
        change = as_floats(np.linalg.solve(known, (scaled * weight).T @ off))
        if np.isinf(dof):
            break
    spread = np.linalg.inv(information(axes, dof) * scaled.T @ scaled + prior)
    covariance = root @ spread @ root.T
    return WearState(state.mean + root @ change, 0.5 * (covariance + covariance.T))


def _root(state: WearState) -> FloatArray:
    """Return a root R of the covariance R R^T; entries that are known exactly have none."""
    size = state.deviation
    unit = np.where(size > 0.0, size, 1.0)
    share = state.covariance / np.outer(unit, unit) + np.diag(size == 0.0)
    return as_floats(size[:, None] * np.linalg.cholesky(share))


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


# Have the latest runs changed as no wear does? Too fast, or too far from the calibration.

WIDE_PRIOR = 30.0
"""How far a sudden change may go, a standard deviation in scatters: as good as anywhere."""
CHANCE = 4.0
"""The latest runs may lie this many standard deviations off by chance."""
FEWEST = 5
"""Runs below which nothing is said of a sudden change."""


def exceeds_wear_limits(
    window: Sequence[RunEvidence],
    references: Sequence[WearState],
    start: WearState,
    unit: FloatArray,
    limits: WearLimits,
    dof: float,
) -> tuple[int, bool] | None:
    """Return what has changed more than wear can make it; None: nothing.

    The runs are compared with the tracked state and with what it was a horizon ago: a fault that
    grows slowly drags the state along before it shows.

    Args:
        window: The latest runs, none of them learned yet.
        references: The tracked state, then earlier ones.
        start: Wear of the calibration.
        unit: Wear that moves a motor by its scatter, (2 motor,).
        limits: How fast and how far wear may go.
        dof: Degrees of freedom of the scatter.

    Returns:
        The entry of the wear that stands out, and whether it changes too fast, rather than lies
        too far from the calibration.
    """
    runs = [run for run in window if run.error.size]
    if len(runs) < FEWEST:
        return None
    change = sudden_change(references[0], runs, unit, dof)
    now = references[0].mean + change.mean

    def off(known: WearState, most: float) -> FloatArray:
        """Return by how much each entry lies off beyond `most` and chance."""
        chance = CHANCE * np.hypot(change.deviation, known.deviation)
        return np.abs(now - known.mean) - most * unit - chance

    fast = np.max([off(known, limits.reach) for known in references], axis=0)
    excess = np.maximum(fast, off(start, limits.limit))
    over = np.divide(excess, unit, out=np.zeros_like(unit), where=unit > 0.0)
    worst = int(np.argmax(over))
    return (worst, bool(fast[worst] > 0.0)) if over[worst] > 0.0 else None


def sudden_change(
    state: WearState, window: Sequence[RunEvidence], unit: FloatArray, dof: float
) -> WearState:
    """Return how far runs lie off a state if their wear is one and the same, whatever it is.

    Args:
        state: Tracked state; taken as it is.
        window: The runs.
        unit: Wear that moves a motor by its scatter, (2 motor,).
        dof: Degrees of freedom of the scatter.

    Returns:
        Difference to `state`, with the covariance that the scatter of the runs gives it.
    """
    anywhere = WearState(state.mean, np.diag((WIDE_PRIOR * unit) ** 2))
    full = [run for run in window if run.error.size]
    if not full:
        return WearState(np.zeros_like(unit), anywhere.covariance)
    error = np.concatenate([run.error for run in full])
    together = RunEvidence("", "", error, np.concatenate([run.design for run in full]))
    found = learn(anywhere, together, dof)
    return WearState(found.mean - state.mean, found.covariance)
