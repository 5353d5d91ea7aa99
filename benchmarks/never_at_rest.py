"""Arms that never rest: every run a continuous motion, simulated, nothing known of the robot.

    python benchmarks/never_at_rest.py [--robot armpi_fpv ur5e so101 panda] [--motion blended ...]
        [--rate 10] [--calibration generic] [--healthy 20] [--faulty 3] [--clock 0.0] [--folder]
        [--calibrated 20] [--told] [--watch 120] [--rest 5] [--sensing encoders] [--also lag slow]
    python benchmarks/never_at_rest.py --logs FOLDER [--share 0.85] [--calibration armpi_fpv]

Five motions, ten seconds each: point to point without a stop, sinusoids, splines as of a leader
arm, set points at 125 Hz, pick and place in a loop. Each run is of another robot (with `--folder`
all are of one), drawn from what its class is like: bias, sag, friction, lag; scatter wanders within
a second or so. A motor gets stuck at any time, or is off by two to four times what can be seen of
it: by another error after each stroke, or, on curves, by one that comes in mid-run. With
`--calibrated N` all are of one robot, calibrated from N healthy runs of the same motion. With
`--rest` an arm stands still for the last seconds of its runs. With `--also lag` motors also come to
follow 0.2 s late in mid-run, with `--also slow` they lose half of their speed: ramps take twice as
long and begin where the last was cut off, on curves the motor keeps below half of its largest
speed. With `--also backlash` joints come to have play, with `--also intermittent` motors stick now
and then. With
`--told` the diagnosis is told the shares of healthy and faulty runs and the sizes of errors as
drawn: only then can the calibration error be that of chance.
"""

from __future__ import annotations

import argparse
import time as clock
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import xarray as xr
from scipy.interpolate import CubicSpline
from telling import calibration, nats, right

import failuretwin as ft
from failuretwin.core.hypothesis import Diagnosis, Hypothesis, paper_hypotheses
from failuretwin.core.movements import find_movements
from failuretwin.core.runs import RunTable, Truth, concatenate
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.nonidealities import Imperfections, vary
from failuretwin.digital_model.robot import Robot, load_robot
from failuretwin.digital_model.servo import first_order_lag
from failuretwin.digital_model.settling import Settling
from failuretwin.digital_model.twin import DigitalTwin, Drive, ServoEngine
from failuretwin.failure_behavior.fault import draw_episodes
from failuretwin.failure_behavior.registry import MODES as MODE_TABLE

STEP_S, DURATION_S = 0.008, 10.0
DELAY_S, LAG_S = (0.0, 0.05), (0.02, 0.05)
"""Ranges of dead time and lag that robots are drawn from [s]."""
LAG_OF_LOGS_S = 0.05
"""Lag of the motors behind their commands in the logs [s]."""
STIFFNESS = 0.4
"""Deviation of the logarithm of compliances that robots are drawn from."""
WANDER_S = 1.0
"""Time within which the scatter of a moving motor is another [s]."""
NOISE_OF_REACH = 5e-4
"""Noise of the tool sensor on each axis, in the reach."""

MOTIONS_TRIED = 3
"""Motions by which the smallest error that is seen is told."""
ONSET_OF_CURVES = 0.2, 0.5
"""When errors on curves come, as shares of a run."""

OWN_SEED = 500_000
"""Seed of the first healthy run that a robot is calibrated from."""
NEVER = 1e-6
"""Factor on the odds of faults that are not drawn."""

Path = Callable[[Robot, FloatArray, np.random.Generator], tuple[FloatArray, FloatArray]]
"""Command (time, motor) [rad] of a robot, and when its strokes end [s]; curves have none."""


def _range(robot: Robot) -> tuple[FloatArray, FloatArray]:
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    return low, high


def blended(
    robot: Robot, time: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return ramps from target to target, each beginning where the last one ends."""
    low, high = _range(robot)
    ends = np.r_[0.0, np.cumsum(rng.uniform(0.9, 1.6, round(1.2 * time[-1])))]
    targets = rng.uniform(low, high, (len(ends), len(low)))
    return np.stack([np.interp(time, ends, one) for one in targets.T], axis=-1), ends


def sinusoids(
    robot: Robot, time: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return a sum of two sinusoids for each motor."""
    low, high = _range(robot)
    frequency = rng.uniform(0.08, 0.35, (2, len(low)))
    phase, share = rng.uniform(0.0, 2.0 * np.pi, (2, len(low))), rng.uniform(0.3, 0.7, len(low))
    wave = np.sin(2.0 * np.pi * frequency * time[:, None, None] + phase)
    mixed = share * wave[:, 0] + (1.0 - share) * wave[:, 1]
    return 0.5 * (low + high) + 0.5 * (high - low) * mixed, np.zeros(0)


def splines(
    robot: Robot, time: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return smooth curves through irregular points, as a person guides a leader arm."""
    low, high = _range(robot)
    at = np.r_[0.0, np.cumsum(rng.uniform(0.5, 1.8, round(2.4 * time[-1])))]
    found = CubicSpline(at, rng.uniform(low, high, (len(at), len(low))))(time)
    return np.clip(found, low, high), np.zeros(0)


def set_points(
    robot: Robot, time: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return minimum-jerk strokes streamed as set points, as servoj does, none at rest."""
    low, high = _range(robot)
    at = np.r_[0.0, np.cumsum(rng.uniform(1.0, 2.0, round(1.4 * time[-1])))]
    targets = rng.uniform(low, high, (len(at), len(low)))
    place = np.clip(np.searchsorted(at, time, side="right") - 1, 0, len(at) - 2)
    share = ((time - at[place]) / np.diff(at)[place])[:, None]
    smooth = 0.5 * share + 0.5 * (10 * share**3 - 15 * share**4 + 6 * share**5)
    return targets[place] + smooth * (targets[place + 1] - targets[place]), at


def pick_and_place(
    robot: Robot, time: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return a cycle of four poses with rounded corners, again and again."""
    low, high = _range(robot)
    poses, cycles = rng.uniform(low, high, (4, len(low))), round(0.5 * time[-1])
    at = np.cumsum(np.r_[0.0, np.tile(rng.uniform(0.7, 1.2, 4), cycles)])
    told = [np.tile(one, cycles + 1)[: len(at)] for one in poses.T]
    raw = np.stack([np.interp(time, at, one) for one in told], axis=-1)
    width = round(0.2 / STEP_S)
    padded = np.pad(raw, ((width, width), (0, 0)), mode="edge")
    kernel = np.ones(2 * width + 1) / (2 * width + 1)
    return np.stack([np.convolve(one, kernel, mode="valid") for one in padded.T], axis=-1), at


MOTIONS: dict[str, Path] = {
    "blended": blended,
    "sinusoids": sinusoids,
    "splines": splines,
    "set_points": set_points,
    "pick_and_place": pick_and_place,
}


@dataclass(frozen=True)
class Case:
    """One run to simulate: its fault, and its seed."""

    fault: str
    motor: int
    seed: int


MODES = ("stuck", "steady_state_error")
LATE, DEAD_S = "lag", 0.2
"""The mode of motors that come to follow late, and by how much [s]."""
SLOW, SPEED = "slow", 0.5
"""The mode of motors that lose speed, and what is left of it."""
PLAY, PLAY_RAD = "backlash", (0.06, 0.14)
"""The mode of joints with play, and the range of the play [rad]."""
STICKS, SHARE = "intermittent", (0.2, 0.6)
"""The mode of motors that stick now and then, and the share of the time that they do."""


def cases(
    robot: Robot, modes: Sequence[str], healthy: int, faulty: int, seed: int
) -> Iterator[Case]:
    """Yield healthy runs, and some of each motor and mode."""
    for n in range(healthy):
        yield Case("healthy", -1, seed + n)
    for motor in range(len(robot.motors)):
        for mode in modes:
            for n in range(faulty):
                yield Case(mode, motor, seed + 1000 * (motor + 1) + n)


LEAST_TIMES, MOST_TIMES = 2.0, 4.0
"""Errors, in the smallest that is seen."""


def smallest_seen(robot: Robot, motion: Path, seed: int) -> FloatArray:
    """Return the smallest error of each motor that a motion shows, (motor,) [rad].

    NaN: none, or larger ones would be beyond all that is considered.
    """
    time = as_floats(STEP_S * np.arange(round(DURATION_S / STEP_S) + 1))
    made = [motion(robot, time, np.random.default_rng([seed, n])) for n in range(MOTIONS_TRIED)]
    onset = 0.0 if motion is blended else float(np.mean(ONSET_OF_CURVES)) * DURATION_S
    names = [f"{motor}:steady_state_error" for motor in robot.motor_names]
    commands = np.stack([command for command, _ in made])
    found = ft.isolability(robot, commands, time, "generic", names, onset_s=onset)
    sizes = np.array([np.nan if found.detected[n] is None else found.detected[n] for n in names])
    largest = np.array([found.largest[name] for name in names])
    return np.where(MOST_TIMES * sizes <= largest, sizes, np.nan)


@dataclass(frozen=True)
class Arm:
    """What one robot is like: where its motors settle, how far they trail their commands [s]."""

    settling: Settling
    compliance: FloatArray
    delay_s: float
    lag_s: float

    @classmethod
    def drawn(cls, robot: Robot, rng: np.random.Generator) -> Arm:
        """Return a robot drawn from what its class is like."""
        usual, motors = generic_imperfections(robot), len(robot.motors)
        settling = vary(usual, rng).settling or Settling.ideal(motors)
        stiffness = np.exp(STIFFNESS * rng.standard_normal(motors))
        compliance = np.asarray((usual.settling or settling).compliance) * stiffness
        return cls(settling, compliance, rng.uniform(*DELAY_S), rng.uniform(*LAG_S))


def simulated(
    robot: Robot,
    motion: Path,
    case: Case,
    rate: float,
    late: float,
    seen: FloatArray,
    arm: Arm | None = None,
    duration_s: float = DURATION_S,
) -> RunTable:
    """Return one run of an arm; None: of one of its own.

    Errors are in units of the smallest that are seen of each motor, (motor,) [rad].
    """
    rng = np.random.default_rng([case.seed, len(robot.motors)])
    time = as_floats(STEP_S * np.arange(round(duration_s / STEP_S) + 1))
    (command, strokes), motors = motion(robot, time, rng), len(robot.motors)
    arm = arm or Arm.drawn(robot, rng)
    settling = arm.settling
    knots = np.arange(0.0, duration_s + 2.0 * WANDER_S, WANDER_S)
    scatter = CubicSpline(knots, rng.standard_normal((len(knots), motors)))(time)
    scatter *= np.asarray(settling.scatter)
    error, onset, size = np.zeros((len(time), motors)), np.nan, np.nan
    if case.fault == "steady_state_error":
        onset = 0.0 if len(strokes) else rng.uniform(*ONSET_OF_CURVES) * duration_s
        error[:, case.motor] = _errors(time, strokes, onset, rng) * seen[case.motor]
    speed = np.gradient(command, STEP_S, axis=0)
    friction = np.asarray(settling.friction) * _direction(speed)
    followed = command.copy()
    if case.fault in (LATE, SLOW, PLAY, STICKS):
        onset = rng.uniform(*ONSET_OF_CURVES) * duration_s
    told = command[:, max(case.motor, 0)]
    if case.fault == SLOW and motion is blended:
        followed[:, case.motor] = _slowed(time, told, strokes, onset)
    elif case.fault == SLOW:
        followed[:, case.motor] = _limited(time, told, onset)
    if case.fault == PLAY:
        size = rng.uniform(*PLAY_RAD)
        followed[:, case.motor] = _with_play(np.where(time < onset, 0.0, size), told)
    if case.fault == LATE:
        size, late_by = DEAD_S, np.where(time < onset, 0.0, DEAD_S)
        followed[:, case.motor] = np.interp(time - late_by, time, told)
    wanted = followed + np.asarray(settling.bias) - friction + scatter + error
    wanted = np.stack([np.interp(time - arm.delay_s, time, one) for one in wanted.T], axis=-1)
    wanted = first_order_lag(wanted.T, wanted[0], STEP_S, arm.lag_s).T
    held = np.zeros((1, len(time), motors), dtype=bool)
    if case.fault == "stuck":
        onset = rng.uniform(0.0, 0.7 * duration_s)
        held[0, time >= onset, case.motor] = True
    if case.fault == STICKS:
        size = rng.uniform(*SHARE)
        parts = draw_episodes(onset, duration_s, size, MODE_TABLE[STICKS].episode_s, rng)
        for begin, end in parts:
            held[0, (time >= begin) & (time < end), case.motor] = True
    drive = Drive(wanted[None], held, compliance=arm.compliance[None])
    position = ServoEngine(robot).angles(drive, time)[0]
    measured, read = _sensed(robot, position, time, rate, late, rng)
    # The error of a ramp is that at its end; on curves it is what there is on the way.
    ends = strokes[(strokes > 0.0) & (strokes <= time[-1])] if motion is blended else np.zeros(0)
    whose, when = max(case.motor, 0), ends if len(ends) else time[time >= np.nan_to_num(onset)]
    there = np.interp(when, time, error[:, whose])
    size = float(np.nan_to_num(size, nan=np.sqrt(np.mean(there**2))))
    name = "healthy" if case.motor < 0 else f"{robot.motor_names[case.motor]}:{case.fault}"
    return RunTable(
        run=[f"{name}/{case.seed}"],
        motor=robot.motor_names,
        time=time,
        command=command[None],
        measured=measured[None],
        position=read[None],
        measured_rate_hz=rate,
        truth=Truth([name], [{}], np.array([onset]), np.array([size])),
        attributes={"robot": robot.name, "source": "simulated"},
    )


def _direction(speed: FloatArray) -> FloatArray:
    """Return the sign of the last travel of each motor, smooth where it turns, (time, motor)."""
    smooth = np.tanh(speed / 0.02)
    at = np.where(speed != 0.0, np.arange(len(speed))[:, None], 0)
    return np.take_along_axis(smooth, np.maximum.accumulate(at, axis=0), axis=0)


def _errors(
    time: FloatArray, strokes: FloatArray, onset: float, rng: np.random.Generator
) -> FloatArray:
    """Return errors, (time,), in the smallest that is seen: of each stroke, or of a curve."""
    if not len(strokes):
        return np.where(
            time >= onset, rng.uniform(LEAST_TIMES, MOST_TIMES) * rng.choice([-1.0, 1.0]), 0.0
        )
    size = rng.uniform(LEAST_TIMES, MOST_TIMES, len(strokes)) * rng.choice(
        [-1.0, 1.0], len(strokes)
    )
    return np.interp(time, strokes, size)


def _slowed(time: FloatArray, command: FloatArray, strokes: FloatArray, onset: float) -> FloatArray:
    """Return where a motor is told to be that makes its strokes slowly from an onset on [rad]."""
    found, ends = command.copy(), np.append(strokes, np.inf)
    here = np.nan
    for begin, end in pairwise(ends.tolist()):
        if begin < onset or begin > time[-1]:
            continue
        low, high = np.interp([begin, min(end, time[-1])], time, command)
        here = low if np.isnan(here) else here
        inside = (time >= begin) & (time <= end)
        told = np.interp(begin + SPEED * (time[inside] - begin), time, command)
        share = (told - low) / (high - low) if high != low else np.zeros(inside.sum())
        found[inside] = here + (high - here) * share
        here = found[inside][-1]
    return found


def _limited(time: FloatArray, command: FloatArray, onset: float) -> FloatArray:
    """Return where a motor gets that keeps below a share of its largest speed from an onset on."""
    step = SPEED * np.abs(np.diff(command)).max()
    found, first = command.copy(), int(np.searchsorted(time, onset))
    for k in range(max(first, 1), len(found)):
        found[k] = found[k - 1] + np.clip(command[k] - found[k - 1], -step, step)
    return found


def _with_play(play: FloatArray, command: FloatArray) -> FloatArray:
    """Return where a joint with play stands whose motor follows a command, (time,) [rad]."""
    found = command.copy()
    for k in range(1, len(found)):
        found[k] = np.clip(found[k - 1], command[k] - 0.5 * play[k], command[k] + 0.5 * play[k])
    return found


def _sensed(
    robot: Robot,
    position: FloatArray,
    time: FloatArray,
    rate: float,
    late: float,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Return what the tool sensor and the encoders read, (time, axis) [m], (time, motor) [rad]."""
    at = np.arange(0.0, time[-1], 1.0 / rate)
    seen = np.stack([np.interp(at - late, time, one) for one in position.T], axis=-1)
    if robot.profile.sensor_pose == "log":
        units = robot.servo_units
        seen = units.to_rad(np.round(units.to_counts(seen)))
        points = DigitalTwin(robot).path(seen)
    else:
        points = DigitalTwin(robot).path(seen)
        points = points + rng.normal(0.0, NOISE_OF_REACH * robot.reach, points.shape)
    measured, read = np.full((len(time), 3), np.nan), np.full(position.shape, np.nan)
    when = np.rint(at / STEP_S).astype(int)
    measured[when], read[when] = points, seen
    return measured, read


def resting(motion: Path, rest_s: float) -> Path:
    """Return a motion that stands still for its last seconds."""

    def made(
        robot: Robot, time: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        command, strokes = motion(robot, time, rng)
        last = int(np.searchsorted(time, time[-1] - rest_s))
        return command[np.minimum(np.arange(len(time)), last)], strokes[strokes < time[last]]

    return made if rest_s else motion


def without_rests(runs: xr.Dataset, share: float | None) -> xr.Dataset:
    """Return runs with the readings of the ramps alone, or one of each at a share of its time."""
    time, measured = runs["time"].values, runs["measured"].values.copy()
    movements = find_movements(runs["command"].values, time)
    kept = np.zeros(measured.shape[:2], dtype=bool)
    for run, m in np.argwhere(movements.exists):
        begin = movements.start[run, m] + LAG_OF_LOGS_S
        length = movements.ramp_duration[run, m].max()
        seen = np.isfinite(measured[run]).all(axis=-1)
        here = np.flatnonzero(seen & (time > begin) & (time < begin + length))
        if share is not None and len(here):
            here = here[[np.argmin(np.abs(time[here] - begin - share * length))]]
        kept[run, here] = True
    measured[~kept] = np.nan
    return runs.assign(measured=(runs["measured"].dims, measured))


def of_logs(folder: str, share: float | None, calibration: str) -> None:
    """Judge the labelled runs of a folder without their rests."""
    robot = load_robot("armpi_fpv")
    runs = ft.read_runs(folder, robot, ft.ReadOptions(published_labels=True))
    began = clock.process_time()
    found = ft.diagnose(without_rests(runs.load(), share), robot, calibration)
    print(f"{calibration}: {line(found, clock.process_time() - began)}")


EVERY = 5
"""Steps of a run from one sample of a stream to the next."""


def watched(robot: Robot, run: RunTable) -> tuple[str, float, str]:
    """Watch a run as a stream; return its truth, seconds to the first alarm since, and its cause.

    Before the onset, or of a healthy robot: seconds since the beginning. No alarm: infinite.
    """
    watch, data = ft.monitor(robot, "generic"), run.to_dataset().isel(run=0)
    truth, onset = str(data["fault"].values), float(data["onset"].values)
    points, time = data["measured"].values, data["time"].values
    for k in range(len(time)):
        read = np.isfinite(points[k]).all()
        if k % EVERY and not read:
            continue
        alarm = watch.update(time[k], data["command"].values[k], points[k] if read else None).alarm
        if alarm.state == "alarm":
            begin = 0.0 if np.isnan(onset) or time[k] < onset else onset
            return truth if begin else "healthy", time[k] - begin, alarm.cause
    return truth, np.inf, ""


def watch_line(found: list[tuple[str, float, str]], duration_s: float) -> str:
    """Return what was found of some streams."""
    false = sum(truth == "healthy" and seconds < np.inf for truth, seconds, _ in found)
    parts = [f"{false} false alarms in {len(found)} streams of {duration_s:g} s"]
    for mode in ("stuck", "steady_state_error"):
        some = [(seconds, cause == truth) for truth, seconds, cause in found if mode in truth]
        right = [seconds for seconds, named in some if named and seconds < np.inf]
        middle = np.median(right) if right else np.nan
        parts.append(f"{mode}: {len(right)} of {len(some)} named, after {middle:.1f} s (median)")
    return ", ".join(parts)


def as_drawn(robot: Robot, some: Sequence[Case], seen: FloatArray) -> ft.Priors:
    """Return the shares and sizes that cases are drawn by; `seen` as of `simulated`."""
    healthy = sum(case.motor < 0 for case in some)
    faults = {(case.motor, case.fault) for case in some if case.motor >= 0}
    each = (len(some) - healthy) / len(faults)
    sizes = {
        name: ((LEAST_TIMES * size, MOST_TIMES * size),)
        for name, size in zip(robot.motor_names, seen.tolist(), strict=True)
        if size > 0.0
    }
    never = [f"{name}:steady_state_error" for name in robot.motor_names if name not in sizes]
    return ft.Priors(
        error_ranges=sizes, healthy_odds=healthy / each, fault_factors=dict.fromkeys(never, NEVER)
    )


@dataclass(frozen=True)
class Judge:
    """Who judges the runs of one robot and motion."""

    robot: Robot
    motion: Path
    sensed: tuple[float, float, FloatArray, Arm | None]
    given: argparse.Namespace

    def table(self, some: Sequence[Case]) -> xr.Dataset:
        """Return the runs of some cases."""
        tables = [simulated(self.robot, self.motion, case, *self.sensed) for case in some]
        return concatenate([table.to_dataset() for table in tables])

    def found(self, runs: xr.Dataset, some: Sequence[Case]) -> tuple[list[Diagnosis], float]:
        """Return what is found of the runs of some cases, and the processor time it takes [s]."""
        given = self.given
        known: Imperfections | str = given.calibration
        if given.calibrated:
            own = [Case("healthy", -1, OWN_SEED + n) for n in range(given.calibrated)]
            known = ft.calibrate(self.table(own), self.robot).imperfections
        priors = as_drawn(self.robot, some, self.sensed[2]) if given.told else None
        began = clock.process_time()
        if given.folder:
            found = ft.SelfCalibratingDiagnoser(self.robot).diagnose(runs)
        else:
            motors = self.robot.motor_names
            also = [Hypothesis.parse(f"{motor}:{mode}") for mode in given.also for motor in motors]
            hypotheses = [*paper_hypotheses(motors), *also] if also else None
            found = ft.diagnose(
                runs, self.robot, known, hypotheses, priors=priors, sensing=given.sensing
            )
        return found, clock.process_time() - began


def line(found: list[Diagnosis], seconds: float) -> str:
    """Return what was found of some runs."""
    healthy = [d for d in found if d.truth == "healthy"]
    false = sum(d.diagnosis != "healthy" for d in healthy)
    parts = [f"healthy blamed {false} of {len(healthy)}"]
    for mode in (*MODES, LATE, SLOW, PLAY, STICKS):
        some = [d for d in found if str(d.truth).endswith(mode)]
        if some or mode in MODES:
            parts.append(f"{mode} {int(right(some).sum())} of {len(some)}")
    sure = sum(d.diagnosis != d.truth and max(d.posterior.values()) > 0.99 for d in found)
    parts.append(f"wrong above 99 % {sure}, {nats(found).mean():.3f} nats")
    parts.append(f"{1e3 * seconds / len(found):.0f} ms a run")
    return ", ".join(parts)


ENDS = ("onset_90", "onset"), ("magnitude_90", "magnitude")
"""Intervals of a diagnosis and what they should hold."""


def intervals(found: list[Diagnosis], runs: xr.Dataset) -> str:
    """Return how many 90 % intervals hold the truth, of the faults that are named right."""
    told = []
    for mode, field, name in (
        ("stuck", "onset_90", "onset"),
        ("steady_state_error", "onset_90", "onset"),
        ("steady_state_error", "magnitude_90", "magnitude"),
        *((mode, field, name) for mode in (LATE, PLAY, STICKS) for field, name in ENDS),
    ):
        pairs = zip(found, as_floats(runs[name].values).tolist(), strict=True)
        some = [
            (getattr(d, field), value)
            for d, value in pairs
            if d.diagnosis == d.truth and str(d.truth).endswith(mode)
        ]
        inside = sum(bool(ends) and ends[0] <= value <= ends[1] for ends, value in some)
        if some or mode in MODES:
            told.append(f"{name} of {mode} {inside} of {len(some)}")
    return f"in their 90 % intervals: {', '.join(told)}"


def main() -> None:
    """Judge all motions of all robots."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robot", nargs="+", default=["armpi_fpv", "so101", "ur5e", "panda"])
    parser.add_argument("--motion", nargs="+", default=list(MOTIONS), choices=list(MOTIONS))
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--calibration", default="generic")
    parser.add_argument("--healthy", type=int, default=20)
    parser.add_argument("--faulty", type=int, default=3)
    parser.add_argument("--clock", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--watch", type=float, help="length of streams that are watched [s]")
    parser.add_argument("--folder", action="store_true", help="one robot, judged together")
    parser.add_argument("--calibrated", type=int, default=0, help="from so many healthy runs")
    parser.add_argument("--told", action="store_true", help="shares and sizes as drawn")
    parser.add_argument("--rest", type=float, default=0.0, help="last seconds that stand still")
    parser.add_argument("--sensing", default="tool", help="what is believed")
    parser.add_argument(
        "--also", nargs="+", default=[], choices=[LATE, SLOW, PLAY, STICKS], help="more faults"
    )
    parser.add_argument("--logs")
    parser.add_argument("--share", type=float)
    given = parser.parse_args()
    if given.logs:
        of_logs(given.logs, given.share, given.calibration)
        return
    every: list[Diagnosis] = []
    for name in given.robot:
        robot = load_robot(name)
        for motion in given.motion:
            modes = (*MODES, *given.also)
            some = list(cases(robot, modes, given.healthy, given.faulty, given.seed))
            path = resting(MOTIONS[motion], given.rest)
            one = given.folder or given.calibrated
            arm = Arm.drawn(robot, np.random.default_rng(given.seed)) if one else None
            seen = smallest_seen(robot, MOTIONS[motion], given.seed)
            told = ", ".join(f"{value:.2f}" for value in np.degrees(seen))
            print(f"{name} {motion}: errors are seen from {told} deg on", flush=True)
            some = [c for c in some if c.fault != "steady_state_error" or seen[c.motor] > 0.0]
            sensed = given.rate, given.clock, seen, arm
            if given.watch:
                lasts = (*sensed, given.watch)
                streams = (simulated(robot, path, c, *lasts) for c in some)
                alarms = [watched(robot, stream) for stream in streams]
                print(f"{name} {motion}: {watch_line(alarms, given.watch)}", flush=True)
                continue
            judge = Judge(robot, path, sensed, given)
            runs = judge.table(some)
            found, seconds = judge.found(runs, some)
            print(f"{name} {motion}: {line(found, seconds)}", flush=True)
            print(f"{name} {motion}: {intervals(found, runs)}", flush=True)
            every += found
    if every:
        print(f"all: {line(every, np.nan)}, {calibration(every, np.random.default_rng(0))}")


if __name__ == "__main__":
    main()
