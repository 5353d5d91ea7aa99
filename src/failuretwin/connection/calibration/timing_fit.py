"""Delay, lag and early ramp ends from the motion between the plateaus, for all runs at once.

Each run has a delay and a ramp shortening of its own; the lag is that of the robot. For each lag
tried, Gauss-Newton with robust weights finds the other two for every run; the lag with the least
cost wins, and runs drawn again and again (bootstrap) say how sure all three are together: a lag
that is too short makes every delay too long.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.imperfect import lagged
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

LAGS_S = np.linspace(0.0, 0.08, 11)
"""Lags tried [s]; a spline through their costs refines the choice. Steps of 10 ms and more are too
coarse: they pull the lag of clean motion by 0.3 ms."""
DELAY_STEP_S, SHARE_STEP = 0.005, 0.01
"""Steps of the numerical derivatives by delay [s] and by shortening [-]."""
ROUNDS = 6
SCALE_RAD, SCALE_M = 0.008, 0.0015
"""Residuals beyond this count less: two counts of a motor, 1.5 mm of the tool."""
DRAWS = 400
BOUNDS = ((-0.15, 0.4), (-0.3, 0.5))
"""Delay [s] and shortening [-] stay within these."""


@dataclass(frozen=True)
class Transients:
    """Readings on the ramps of many runs.

    Attributes:
        movements: The movements as the motors make them but for delay, lag, shortening and
            gravity: their targets are where they would settle without load.
        yielding: How far gravity moves the motors, (run, time, motor) [rad]. It goes by the pose,
            so it is not spread evenly over a ramp.
        reading: Motor angles (run, time, motor) [rad] or tool positions (run, time, axis) [m].
        of_motors: Whether `reading` holds angles.
        used: Which of them count, (run, time).
        time: Grid, (time,) [s].
    """

    movements: Movements
    yielding: FloatArray
    reading: FloatArray
    of_motors: bool
    used: BoolArray
    time: FloatArray


@dataclass(frozen=True)
class TimingFit:
    """Timing of a robot.

    Attributes:
        delay: Of each run that tells, (run,) [s].
        shortening: Of each run that tells, (run,).
        lag: Lag of the robot [s].
        doubt: Half 95 % intervals of mean delay [s], mean shortening and lag [s].
        residual: Typical residual left (1.48 MAD) [rad or m].
    """

    delay: FloatArray
    shortening: FloatArray
    lag: float
    doubt: tuple[float, float, float]
    residual: float


def fit_timing(transients: Transients, robot: Robot, rng: np.random.Generator) -> TimingFit | None:
    """Fit the timing of a healthy robot; None if fewer than three runs show ramps.

    Args:
        transients: Readings on the ramps.
        robot: The robot.
        rng: For the bootstrap.
    """
    telling = np.flatnonzero(transients.used.sum(axis=1) >= 12)
    if len(telling) < 3:
        return None
    transients = _some(transients, telling)
    runs = len(telling)
    costs = np.empty((len(LAGS_S), runs))
    values = np.empty((len(LAGS_S), runs, 2))
    start = np.zeros((runs, 2))
    for i, lag in enumerate(LAGS_S):
        values[i], costs[i] = _fit_runs(transients, robot, float(lag), start)
        start = values[i]
    lag = _least(costs.sum(axis=1))
    found, _ = _fit_runs(transients, robot, lag, values[int(np.argmin(np.abs(LAGS_S - lag)))])
    left = _residual(transients, robot, found, lag)
    left = np.abs(left[transients.used]).ravel()
    return TimingFit(
        delay=found[:, 0],
        shortening=found[:, 1],
        lag=lag,
        doubt=joint_doubt(values, costs, rng),
        residual=float(1.4826 * np.nanmedian(left)),
    )


def joint_doubt(
    values: FloatArray, costs: FloatArray, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Return half 95 % intervals of mean delay, mean shortening and lag, from runs drawn again.

    The spread of such draws is too small by the share (n - 1)/n of a variance of n runs, and is
    itself not known well from few: hence the quantile of Student's t.

    Args:
        values: Delay and shortening at `LAGS_S`, (lag, run, 2).
        costs: Their costs, (lag, run).
        rng: For the draws.
    """
    from scipy.interpolate import CubicSpline
    from scipy.stats import t

    runs = costs.shape[1]
    chosen = rng.integers(runs, size=(DRAWS, runs))
    lags = np.array([_least(costs[:, some].sum(axis=1)) for some in chosen])
    at_lag = CubicSpline(LAGS_S, values)(lags)
    means = [found[some].mean(axis=0) for found, some in zip(at_lag, chosen, strict=True)]
    spread = np.std(np.column_stack([means, lags]), axis=0) * np.sqrt(runs / (runs - 1.0))
    delay, shortening, lag = (t.ppf(0.975, runs - 1) * spread).tolist()
    return delay, shortening, lag


def _some(transients: Transients, runs: np.ndarray) -> Transients:
    m = transients.movements
    return replace(
        transients,
        movements=Movements(m.initial[runs], m.target[runs], m.ramp_duration[runs], m.start[runs]),
        yielding=transients.yielding[runs],
        reading=transients.reading[runs],
        used=transients.used[runs],
    )


def _least(costs: FloatArray) -> float:
    """Return the lag [s] at the least of a cubic spline through costs at `LAGS_S`.

    The costs bend too unevenly for a parabola: through three of them it is off by up to 3 ms.
    """
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(LAGS_S, costs)
    lags = np.append(spline.derivative().roots(extrapolate=False), LAGS_S[[0, -1]])
    return float(lags[np.argmin(spline(lags))])


def _fit_runs(
    transients: Transients, robot: Robot, lag: float, start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return delay and shortening of each run, (run, 2), and its robust cost, (run,)."""
    values = start.copy()
    steps = (DELAY_STEP_S, SHARE_STEP)
    low, high = np.array(BOUNDS).T
    scale = SCALE_RAD if transients.of_motors else SCALE_M
    for _ in range(ROUNDS):
        residual = _residual(transients, robot, values, lag)
        slopes = []
        for k, step in enumerate(steps):
            moved = values.copy()
            moved[:, k] += step
            slopes.append((_residual(transients, robot, moved, lag) - residual) / step)
        weight = 1.0 / (1.0 + (residual / scale) ** 2)
        slope = np.stack(slopes)
        normal = np.einsum("prtm,qrtm,rtm->rpq", slope, slope, weight)
        normal += 1e-9 * np.eye(2)
        pull = np.einsum("prtm,rtm,rtm->rp", slope, residual, weight)
        values = np.clip(values - np.linalg.solve(normal, pull[..., None])[..., 0], low, high)
    residual = _residual(transients, robot, values, lag)
    return values, np.sum(np.log1p((residual / scale) ** 2), axis=(1, 2))


def _residual(transients: Transients, robot: Robot, values: FloatArray, lag: float) -> FloatArray:
    """Return predicted minus read, (run, time, motor or axis); 0 where a reading does not count."""
    twin = DigitalTwin(robot)
    delay, shortening = values.T
    position = motion(transients.movements, transients.time, twin, delay, shortening, lag)
    position += transients.yielding
    predicted = position if transients.of_motors else twin.path(position)
    residual = np.where(transients.used[..., None], predicted - transients.reading, 0.0)
    return np.nan_to_num(residual)


def motion(
    movements: Movements,
    time: FloatArray,
    twin: DigitalTwin,
    delay: FloatArray,
    shortening: FloatArray,
    lag: float,
) -> FloatArray:
    """Return how motors without load make movements late and short, (run, time, motor) [rad].

    Args:
        movements: Movements between the angles at which the motors would settle without load.
        time: Uniform grid, (time,) [s].
        twin: The servo loops.
        delay: Dead time of each run, (run,) [s].
        shortening: Share by which the ramps of each run end early, (run,).
        lag: Time constant of the lag on top of the servo loops [s].
    """
    moved = replace(
        movements,
        start=movements.start + delay[:, None],
        ramp_duration=movements.ramp_duration * (1.0 - shortening)[:, None, None],
    )
    reference = lagged(moved.reference(time), time, np.full(len(delay), lag))
    return twin.respond(reference, time)
