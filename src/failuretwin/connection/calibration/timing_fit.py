"""Delay, lag and early ramp ends from the motion between the plateaus, for all runs at once.

Each run r has a delay and a ramp shortening x_r of its own; the lag T is that of the robot. The
estimate minimises the profile cost C(T) = sum_r min_x c_r(x, T) with Cauchy's robust loss; for each
lag, Gauss-Newton with robust weights finds x_r of every run.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from failuretwin.connection.calibration.observations import Observations
from failuretwin.connection.calibration.settling_fit import SortedMovements
from failuretwin.core.movements import Movements, find_movements
from failuretwin.core.runs import RunSet, measured_rate
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.digital_model.disturbances import lagged
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, sag
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.observation.readings import measured_samples

LONGEST_LAG_S = 0.08
"""Longest lag looked for [s]."""
LAG_STEP_S = 0.004
"""Step of the derivatives by the lag [s]."""
DELAY_STEP_S, SHARE_STEP = 0.005, 0.01
"""Steps of the numerical derivatives by delay [s] and by shortening [-]."""
ROUNDS = 6
SCALE_RAD, SCALE_M = 0.008, 0.0015
"""Residuals beyond this count less: two counts of a motor, 1.5 mm of the tool."""
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

    def __getitem__(self, runs: IntArray) -> Transients:
        """Return some of the runs."""
        return replace(
            self,
            movements=self.movements[runs],
            yielding=self.yielding[runs],
            reading=self.reading[runs],
            used=self.used[runs],
        )

    def predicted(self, robot: Robot, values: FloatArray, lag: float) -> FloatArray:
        """Return the readings expected, (run, time, motor) [rad] or (run, time, axis) [m].

        `values` are delay [s] and shortening of each run, (run, 2); the lag is the robot's [s].
        """
        twin, (delay, shortening) = DigitalTwin(robot), values.T
        position = motion(self.movements, self.time, twin, delay, shortening, lag) + self.yielding
        return position if self.of_motors else twin.path(position)


@dataclass(frozen=True)
class TimingFit:
    """Timing of a robot.

    Attributes:
        delay: Of each run that tells, (run,) [s].
        shortening: Of each run that tells, (run,).
        lag: Lag of the robot [s].
        doubt: Half 95 % intervals of mean delay [s], mean shortening and lag [s].
    """

    delay: FloatArray
    shortening: FloatArray
    lag: float
    doubt: tuple[float, float, float]


def fit_timing(transients: Transients, robot: Robot) -> TimingFit | None:
    """Fit the timing of a healthy robot; None if fewer than three runs show ramps."""
    from scipy.optimize import minimize_scalar

    telling = np.flatnonzero(transients.used.sum(axis=1) >= 12)
    if len(telling) < 3:
        return None
    ramps = transients[telling]
    start, _ = _fit_runs(ramps, robot, 0.5 * LONGEST_LAG_S, np.zeros((len(telling), 2)))

    def cost(lag: float) -> float:
        return float(_fit_runs(ramps, robot, lag, start)[1].sum())

    least = minimize_scalar(
        cost, bounds=(0.0, LONGEST_LAG_S), method="bounded", options={"xatol": 1e-4}
    )
    lag = float(least.x)
    found, _ = _fit_runs(ramps, robot, lag, start)
    middle = np.clip(lag, LAG_STEP_S, LONGEST_LAG_S - LAG_STEP_S)
    fits = [_fit_runs(ramps, robot, middle + k * LAG_STEP_S, found) for k in (-1.0, 0.0, 1.0)]
    values, costs = (np.stack(part) for part in zip(*fits, strict=True))
    doubt = joint_doubt(values, costs, LAG_STEP_S, float(middle))
    return TimingFit(delay=found[:, 0], shortening=found[:, 1], lag=lag, doubt=doubt)


def joint_doubt(
    values: FloatArray, costs: FloatArray, step: float, lag: float
) -> tuple[float, float, float]:
    """Return half 95 % intervals of mean delay, mean shortening and lag.

    Sandwich estimate with runs as clusters: of n runs, run r moves the lag by
    T_r = -n (c_r' - mean c') / C'' and the mean of x by x_r - mean x + T_r d(mean x)/dT; the
    quantile is that of Student's t with n - 1 degrees of freedom. A lag at its bound moves by the
    share of its interval that lies within the bounds.

    Args:
        values: x, delay and shortening, below, at and above the lag found, (3, run, 2).
        costs: c, their costs, (3, run).
        step: Difference of these lags [s].
        lag: The middle one of them [s].
    """
    from scipy.stats import t

    runs = costs.shape[1]
    slope = (costs[2] - costs[0]) / (2.0 * step)
    curvature = float(np.sum(costs[2] - 2.0 * costs[1] + costs[0])) / step**2
    curvature = max(curvature, float(np.abs(slope).sum()) / LONGEST_LAG_S)
    lag_shift = -runs * (slope - slope.mean()) / max(curvature, 1e-300)
    quantile, count = float(t.ppf(0.975, runs - 1)), runs * (runs - 1.0)
    width = quantile * float(np.sqrt(np.sum(lag_shift**2) / count))
    best = lag - float(slope.sum()) / max(curvature, 1e-300)
    low, high = np.clip([best - width, best + width], 0.0, LONGEST_LAG_S)
    lag_shift = lag_shift * ((high - low) / max(2.0 * width, 1e-300))
    drift = (values[2] - values[0]).mean(axis=0) / (2.0 * step)
    mean_shift = values[1] - values[1].mean(axis=0) + lag_shift[:, None] * drift
    shifts = np.column_stack([mean_shift, lag_shift])
    deviation = np.sqrt(np.sum(shifts**2, axis=0) / count)
    of_delay, of_shortening, of_lag = (quantile * deviation).tolist()
    return of_delay, of_shortening, of_lag


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
    predicted = transients.predicted(robot, values, lag)
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

    Movements lead to the angles at which motors would settle without load, on a uniform grid
    (time,) [s]. Delay [s] and shortening of the ramps are those of each run, (run,); the lag [s] is
    on top of the servo loops.
    """
    moved = replace(
        movements,
        start=movements.start + delay[:, None],
        ramp_duration=movements.ramp_duration * (1.0 - shortening)[:, None, None],
    )
    reference = lagged(moved.reference(time), time, np.full(len(delay), lag))
    return twin.respond(reference, time)


# What the logs say between the plateaus: late starts, gaps, glitches, and ramps for the timing.

LATE_S = 0.15
"""A movement that outlasts the usual time to the next command by this much started late [s]."""
STEADY_S = 0.05
"""Commands whose spacing scatters less than this come at a steady pace [s]."""
AFTER_RAMP_S = 0.25
"""Readings up to this long after a ramp still tell of its timing [s]."""
USUAL_LAG_S = 0.03
"""Lag with which the tool path's poses are guessed, for the sag on the way [s]."""
GAP_PERIODS = 4.0
"""A silence of this many periods of the readings is a gap."""


def lateness(movements: Movements) -> FloatArray:
    """Return how late each movement started, (run, movement) [s]; 0 punctual, NaN not known.

    A late start of a stalled bus holds up the next command. Where commands come at no steady pace,
    nothing is known.
    """
    spacing = np.diff(movements.start, axis=1)
    late = np.full(movements.start.shape, np.nan)
    seen = spacing[np.isfinite(spacing)]
    if len(seen) < 3:
        return late
    period = float(np.median(seen))
    spread = 1.4826 * float(np.median(np.abs(seen - period)))
    if spread <= STEADY_S:
        excess = spacing - period
        late[:, :-1] = np.where(np.isfinite(excess), np.where(excess > LATE_S, excess, 0.0), np.nan)
    return late


def punctual(late: FloatArray) -> BoolArray:
    """Return which movements surely started on time by their lateness, (run, movement).

    The last one of a run holds up no other: it is taken for punctual only if all others were.
    """
    return np.asarray(late == 0.0) if np.any(late > 0.0) else np.ones(late.shape, dtype=bool)


def gap_starts(runs: RunSet, movements: Movements, late: FloatArray) -> FloatArray:
    """Return when readings stop before late starts, after the movement before, (gap,) [s]."""
    time, rate = as_floats(runs["time"].values), measured_rate(runs)
    seen = measured_samples(runs).seen
    found = []
    for run, movement in np.argwhere(np.nan_to_num(late) > 0.0):
        if movement == 0:
            continue
        begin, end = movements.start[run, movement - 1], movements.start[run, movement]
        inside = time[seen[run] & (time > begin) & (time < end + late[run, movement])]
        holes = np.flatnonzero(
            np.diff(np.append(inside, end + late[run, movement])) > GAP_PERIODS / rate
        )
        if len(holes):
            found.append(inside[holes[0]] + 0.5 / rate - begin)
    return np.array(found)


def transients(
    runs: RunSet,
    movements: Movements,
    late: FloatArray,
    seen: Observations,
    became: SortedMovements,
    settling: Settling,
    robot: Robot,
) -> Transients:
    """Return the readings on ramps that began on time and at a known place."""
    time = as_floats(runs["time"].values)
    used = _within(movements, _sound(movements, seen, became) & punctual(late), time)
    of_motors = seen.of_motors
    reading = as_floats(runs["position"].values) if of_motors else measured_samples(runs).point
    free = unloaded_movements(movements, settling)
    if of_motors:
        pose = np.nan_to_num(reading)
    else:
        none = np.zeros(len(movements.start))
        pose = motion(free, time, DigitalTwin(robot), none, none, USUAL_LAG_S)
    return Transients(
        movements=free,
        yielding=sag(robot, pose, np.asarray(settling.compliance), settling.payload),
        reading=reading,
        of_motors=of_motors,
        used=used & np.isfinite(reading).all(axis=2),
        time=time,
    )


def _within(movements: Movements, chosen: BoolArray, time: FloatArray) -> BoolArray:
    """Return which times belong to the ramps of some movements, (run, time)."""
    used = np.zeros((len(movements.start), len(time)), dtype=bool)
    for run, movement in np.argwhere(chosen):
        begin = movements.start[run, movement]
        end = begin + np.nanmax(movements.ramp_duration[run, movement]) + AFTER_RAMP_S
        used[run] |= (time >= begin) & (time < end)
    return used


def _sound(movements: Movements, seen: Observations, became: SortedMovements) -> BoolArray:
    """Return which movements began and ended where they should, (run, movement)."""
    good = np.zeros(movements.start.shape, dtype=bool)
    run, number = seen.at
    fine = ~became.odd & ~became.lost.any(axis=1)
    good[run[fine], number[fine]] = True
    before = np.ones_like(good)
    before[:, 1:] = good[:, :-1]
    return good & before


def unloaded_movements(movements: Movements, settling: Settling) -> Movements:
    """Return the movements with the targets at which motors would settle without load."""
    bias, friction = np.asarray(settling.bias), np.asarray(settling.friction)
    travel = np.nan_to_num(movements.target) - np.nan_to_num(movements.origin())
    return replace(
        movements,
        initial=movements.initial + bias,
        target=movements.target + bias - friction * np.sign(travel),
    )


def movements_of(runs: RunSet) -> Movements:
    """Return the movements of a run set."""
    return find_movements(as_floats(runs["command"].values), as_floats(runs["time"].values))
