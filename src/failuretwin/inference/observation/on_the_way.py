"""Moments on the way: what runs say of movements whose end was not seen at rest.

A stretch is the part of a movement up to one reading. The tool is expected where the command was a
lag before; whoever starts early or late, or follows with another lag, is off along the motion:

    e_k = y(q(t_k - lag)) - J qd (lag of each motor) + J o (share of the bend)
    o = q_T(t_k - lag + T) - q(t_k - lag)

with variance along the motion (qd sigma)^2 and q_T the command as a first-order lag of time
constant T follows it: T^2 qdd / 2 of a smooth command, behind a corner what is left to go.

A rest is a stretch with qd = 0. Readings near each other share one lag and one scatter: they are
pooled. A long curve is read on its way also where the tool rests behind it.

Section: docs/inference.md#moments
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.compiled import compiled
from failuretwin.core.movements import WAY_SAMPLES, Stretches
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.observation.between_commands import strays_between
from failuretwin.inference.observation.evidence import Evidence, SettledEvidence, TransientSamples
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.lag_offset import command_at, lag_offset

SHARE = 0.85
"""Share of a stretch's time at which it is read: late, so that what a motor was told shows, and
before the next command may have come."""
APART_S = 1.0
"""Time from one moment on the way to the next [s]; nearer readings share one lag."""
MOST_MOMENTS = 20
"""Moments of a run at most, unless it has more movements: the work grows with their square."""
MOST_RESTS = 1
"""Rests of a run that is judged on its way: an arm that never stops does so at the end."""
POOLED_S = 0.12
"""Readings this near to that of a moment are pooled with it [s]."""
STANDS_S = 0.12
"""So long after its ramp a tool stands where it was told, give or take its settling [s]."""
CORNER_S = 0.06
"""Speed is the mean over twice that [s]: near a corner of the command a lag tells which it is."""
BEND_S = 0.05
"""Time constant with which motors follow, at most [s], assumed: they are off the command a lag
before by a share of what such a first-order lag makes of it."""
AGES, FOLLOWED = np.polynomial.laguerre.laggauss(8)
"""Ages of a command, in the time constant of such a lag, and the weight of each in what it makes of
the command."""
LEAST_RAMP_S = 1e-3
"""Shortest ramp that is divided by [s]."""
LONG_S = 2.0 * APART_S
"""A curve that lasts longer is read on its way, whether the tool rests behind it or not [s]."""
LEAST_FRICTION_RAD = 1e-4
"""Friction that counts as none [rad]."""
CURVED_RAD = 0.01
"""A movement whose command strays further from straight ramps is a curve [rad]."""


@compiled
def _follow(steps: FloatArray, found: FloatArray) -> None:
    """Follow the direction of friction of each motor, (motor,), along steps (step, motor)."""
    for n in range(len(steps)):
        for k in range(len(found)):
            found[k] = min(max(found[k] + steps[n, k], -1.0), 1.0)


@dataclass(frozen=True)
class _Moment:
    """One stretch of one run; see `Stretches`."""

    start: float
    time: float
    point: FloatArray
    origin: FloatArray
    target: FloatArray
    ramp: FloatArray
    speed: FloatArray
    bend: FloatArray
    direction: FloatArray
    done: FloatArray
    whole: bool
    curved: bool


def hardly_rest(evidence: Evidence, model: HealthyModel) -> BoolArray:
    """Return which runs are judged by readings on the way, (run,).

    Those with long curves, and those with `MOST_RESTS` at most, or with none of a robot whose
    timing is calibrated: where motors settle is known better than how they get there.
    """
    few = _few_rests(evidence, model) | long_curves(evidence).any(axis=1)
    if few.any():
        few &= [not quality.fatal for quality in evidence.quality]
    return few


def _few_rests(evidence: Evidence, model: HealthyModel) -> BoolArray:
    settled = evidence.settled
    rests, movements = settled.usable.sum(axis=1), settled.movements.exists.sum(axis=1)
    most = 0 if model.knows_timing else MOST_RESTS
    return np.asarray((rests <= most) & (2 * rests < movements))


def long_curves(evidence: Evidence) -> BoolArray:
    """Return which movements are curves of more than `LONG_S`, (run, movement)."""
    movements = evidence.settled.movements
    found = np.nan_to_num(movements.ramp_duration).max(axis=-1, initial=0.0) > LONG_S
    for run, m in np.argwhere(found).tolist():
        found[run, m] = _is_curved(evidence, run, m)
    return found


def told_too_seldom(evidence: Evidence, model: HealthyModel, lag_s: float) -> BoolArray:
    """Return which runs hardly rest, and have commands too far apart to tell the way, (run,)."""
    return strays_between(evidence, model, hardly_rest(evidence, model), lag_s)


def likeliest_lag(evidence: Evidence, model: HealthyModel) -> float:
    """Return how far the runs that hardly rest trail their commands [s]; they share a set-up."""
    some = np.flatnonzero(hardly_rest(evidence, model))
    return model.lag_s + lag_offset(evidence, model, some)


def on_the_way(evidence: Evidence, model: HealthyModel, lag_s: float) -> SettledEvidence:
    """Return settled positions, and moments on the way of runs that hardly rest.

    None of runs whose tool leaves the straight way between commands; where their curves end is not
    known either.

    Args:
        evidence: What the runs say.
        model: The healthy robot: how early its ramps end.
        lag_s: How far the tool trails its commands [s], as `likeliest_lag` returns it.
    """
    settled, curves = evidence.settled, long_curves(evidence)
    strays = told_too_seldom(evidence, model, lag_s)
    hardly = hardly_rest(evidence, model) & ~strays
    rests = settled.usable & ~(_arriving(settled, lag_s) & hardly[:, None])
    unseen = settled.movements.exists & ~rests & _few_rests(evidence, model)[:, None]
    unseen = (unseen | curves) & hardly[:, None]
    seen = rests & ~(curves & strays[:, None])
    settled = replace(settled, usable=seen, too_seldom=strays)
    if not unseen.any():
        return settled
    looks = _Looks(evidence, model, lag_s)
    found = {(run, m): looks.moments(run, m) for run, m in np.argwhere(unseen).tolist()}
    if not any(found.values()):
        return settled
    return _with_ways(_joined(settled, found, lag_s), evidence, lag_s)


def _arriving(settled: SettledEvidence, lag_s: float) -> BoolArray:
    """Return the movements whose tool still arrives when readings count as rest, (run, movement).

    It trails its commands by more than it takes to settle, such as where clocks are apart.
    """
    movements = settled.movements
    ends = movements.start + movements.ramp_duration.max(axis=-1, initial=0.0)
    return np.asarray(settled.begin < ends + lag_s)


@dataclass(frozen=True)
class _Looks:
    """Reads moments on the way of single movements.

    Attributes:
        evidence: What the runs say.
        model: The healthy robot.
        lag_s: How far the tool trails its commands [s].
    """

    evidence: Evidence
    model: HealthyModel
    lag_s: float

    def moments(self, run: int, m: int) -> list[_Moment]:
        """Return the moments on the way of a movement."""
        settled, lag = self.evidence.settled, self.lag_s
        movements = settled.movements
        time, read = self.evidence.time, self.evidence.read[run]
        start, end = movements.start[run, m], settled.end[run, m]
        seen = np.flatnonzero(read & (time > start + lag) & (time < end - 1e-9))
        if not len(seen):
            return []
        curved = _is_curved(self.evidence, run, m)
        early = 0.0 if curved else self.model.shortening
        longest = movements.ramp_duration[run, m].max() * (1.0 - early)
        stood = time[seen[-1]] - start - lag
        if not curved and stood > longest + STANDS_S:
            length, share = stood, 1.0
        else:
            length, share = min(longest, end - start - lag), SHARE
        most = max(1, MOST_MOMENTS // int(movements.exists[run].sum()))
        count = min(max(1, round(length / APART_S)), most)
        wanted = start + lag + length * (np.arange(count) + share) / count
        nearest = np.unique(np.argmin(np.abs(time[seen] - wanted[:, None]), axis=1))
        found, before = [], start
        for at in seen[nearest].tolist():
            found.append(self._moment(run, m, at, before, early, curved))
            before = time[at] - lag
        if len(found) > 1:
            found = [replace(one, whole=False) for one in found]
        return found

    def _moment(
        self, run: int, m: int, at: int, begin: float, early: float, curved: bool
    ) -> _Moment:
        time = self.evidence.time
        start = self.evidence.settled.movements.start[run, m]
        end, lag = self.evidence.settled.end[run, m], self.lag_s

        def told(when: FloatArray) -> FloatArray:
            """Return what the motors have been told that is to be seen, (time, motor) [rad]."""
            since = (when - lag - start) / (1.0 - early)
            return command_at(self.evidence, run, np.minimum(start + since, max(end, start)))

        near = self._near(run, at)
        point = self.evidence.readings.point[run]
        pose = told(np.append(time[near], time[at]))
        path = self.model.sensors.expected(pose)[0]
        off = np.median(point[near] - path[:-1], axis=0)
        ends = told(time[at] + CORNER_S * np.array([-1.0, 1.0]))
        followed = FOLLOWED @ told(time[at] + BEND_S * (1.0 - AGES))
        lasted = (time[at] - lag - begin) / (1.0 - early)
        ramp = np.maximum(self.evidence.settled.movements.ramp_duration[run, m], LEAST_RAMP_S)
        return _Moment(
            begin,
            time[at],
            path[-1] + off,
            command_at(self.evidence, run, np.array([begin]))[0],
            pose[-1],
            np.minimum(ramp, lasted),
            (ends[1] - ends[0]) / (2.0 * CORNER_S),
            followed - pose[-1],
            self._friction(run, np.minimum(time[at] - lag, end)),
            np.clip((time[at] - lag - start) / (1.0 - early) / ramp, 0.0, 1.0)
            if not curved
            else np.ones_like(ramp),
            not curved,
            curved,
        )

    def _friction(self, run: int, when: float) -> FloatArray:
        """Return the direction of the friction of each motor at a time, from -1 to 1, (motor,).

        A motor that turns back yields by its friction f to one side, then to the other:
        d <- clip(d + dq / f, -1, 1) along the command q, a play of width 2 f.
        """
        command = self.evidence.command[run]
        steps = np.diff(command[self.evidence.time <= when], axis=0)
        width = np.maximum(np.asarray(self.model.settling.friction), LEAST_FRICTION_RAD)
        found = np.zeros(command.shape[1])
        _follow(steps / width, found)
        return found

    def _near(self, run: int, at: int) -> IntArray:
        """Return the readings about one, as many before as after: what a fault adds cancels."""
        time = self.evidence.time
        near = np.flatnonzero(self.evidence.read[run] & (np.abs(time - time[at]) <= POOLED_S))
        place = int(np.searchsorted(near, at))
        count = min(place, len(near) - 1 - place)
        return near[place - count : place + count + 1]


def _is_curved(evidence: Evidence, run: int, m: int) -> bool:
    """Return whether the command of a movement strays from straight ramps."""
    settled, time = evidence.settled, evidence.time
    start, end = settled.movements.start[run, m], settled.end[run, m]
    when = time[(time >= start) & (time <= end)]
    straight = settled.movements[run : run + 1].reference(when)[0]
    strays = np.abs(command_at(evidence, run, when) - straight).max(initial=0.0)
    return bool(strays > CURVED_RAD)


def _joined(
    settled: SettledEvidence, found: dict[tuple[int, int], list[_Moment]], lag_s: float
) -> SettledEvidence:
    """Return settled positions with moments on the way: in place of movements without, or before.

    Args:
        settled: Settled positions.
        found: Moments on the way of some movements.
        lag_s: How far the tool trails its commands [s].
    """
    movements = settled.movements
    origin = movements.origin()

    def entries(run: int, m: int) -> list[tuple[int, _Moment | None]]:
        way: list[_Moment | None] = list(found.get((run, m), ()))
        rests = bool(settled.usable[run, m]) or not way
        return [(m, moment) for moment in (*way, *([None] * rests))]

    plan = [
        [one for m in np.flatnonzero(movements.exists[run]).tolist() for one in entries(run, m)]
        for run in range(len(settled.usable))
    ]
    count = max(len(one) for one in plan)
    motors, axes = movements.initial.shape[1], settled.point.shape[-1]
    made = SettledEvidence.empty(run=len(plan), movement=count, motor=motors, axis=axes)
    stretches = Stretches.empty(run=len(plan), movement=count, motor=motors, sample=WAY_SAMPLES)
    stretches.initial[:] = movements.initial
    for run, told in enumerate(plan):
        for k, (m, moment) in enumerate(told):
            made.put((run, k), settled[run, m])
            stretches.target[run, k] = movements.target[run, m]
            stretches.ramp_duration[run, k] = movements.ramp_duration[run, m]
            stretches.start[run, k] = movements.start[run, m]
            stretches.beginning[run, k] = origin[run, m]
            stretches.movement[run, k] = m
            if moment is not None:
                _put(made, stretches, (run, k), moment)
            elif way := found.get((run, m)):
                _put_rest(stretches, (run, k), way[-1], lag_s)
    return replace(made, movements=stretches)


def _with_ways(seen: SettledEvidence, evidence: Evidence, lag_s: float) -> SettledEvidence:
    """Return moments with the commands that show from one to the next; the first from the start on.

    Args:
        seen: The moments.
        evidence: What the runs say.
        lag_s: How far the tool trails its commands [s].
    """
    stretches = Stretches.of(seen.movements)
    time = np.maximum.accumulate(np.nan_to_num(0.5 * (seen.begin + seen.end)), axis=1)
    begin = np.concatenate([np.zeros_like(time[:, :1]), time[:, :-1]], axis=1)
    share = (np.arange(WAY_SAMPLES) + 1.0) / WAY_SAMPLES
    when = begin[..., None] + (time - begin)[..., None] * share  # (run, moment, sample)
    for run, at in enumerate(when - lag_s):
        stretches.way[run] = np.moveaxis(command_at(evidence, run, at), 2, 1)
    return replace(seen, movements=stretches)


def _put(made: SettledEvidence, stretches: Stretches, at: tuple[int, int], moment: _Moment) -> None:
    made.point[at], made.usable[at], made.moving[at] = moment.point, True, False
    made.begin[at] = made.end[at] = moment.time
    stretches.target[at], stretches.ramp_duration[at] = moment.target, moment.ramp
    stretches.start[at], stretches.beginning[at] = moment.start, moment.origin
    stretches.speed[at], stretches.at_rest[at] = moment.speed, False
    stretches.whole[at], stretches.curved[at] = moment.whole, moment.curved
    stretches.bend[at], stretches.done[at] = moment.bend, moment.done
    stretches.direction[at] = moment.direction


def _put_rest(stretches: Stretches, at: tuple[int, int], before: _Moment, lag_s: float) -> None:
    """Write that the last stretch of a curve, up to where the tool rests, begins at a moment."""
    begun = before.time - lag_s
    left = stretches.start[at] + stretches.ramp_duration[at] - begun
    stretches.start[at], stretches.beginning[at] = begun, before.target
    stretches.ramp_duration[at] = np.maximum(left, LEAST_RAMP_S)
    stretches.whole[at], stretches.curved[at] = False, True


def beside(moving: TransientSamples, moments: SettledEvidence) -> TransientSamples:
    """Return readings on the way without those of moments, movement by movement of these."""
    stretches = Stretches.of(moments.movements)
    runs = np.arange(len(stretches.movement))[:, None]
    whole = stretches.at_rest & stretches.exists & stretches.whole
    return moving[runs, stretches.movement].where(whole)
