"""Streaming diagnosis of many robots of one kind at once, as arrays.

A sample is taken in three steps: references are followed until a movement can be named; readings
at rest say where the tool settled after it; where that is new, the robot is judged anew by what
its last movements say, with the same arithmetic as a recorded run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.types import ArrayStruct, Axes, BoolArray, FloatArray, IntArray, as_floats
from failuretwin.decision.streaming import STREAMED
from failuretwin.decision.streaming.tracking import MovementTracker
from failuretwin.decision.streaming.trouble import (
    DEAD,
    TWO,
    UNTOLD,
    FrozenSensorDetector,
    TwoPlaces,
    UntoldMotion,
)
from failuretwin.decision.streaming.window import KEEP_S
from failuretwin.digital_model.calibrated_robot import RobotLike
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.engine.registration import run_posterior
from failuretwin.inference.engine.weighing import assembled
from failuretwin.inference.explanation import worded
from failuretwin.inference.faults.prior_odds import log_prior
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.log_quality import LogQuality
from failuretwin.inference.observation.rounding import Rounding, rounded
from failuretwin.inference.posterior import (
    Posterior,
    StreamPosition,
    compute_posterior,
    shows_in_transients,
)

Weigh = Callable[[RunLikelihood, Sequence[Hypothesis], Priors], Posterior]
"""Weighs hypotheses by some runs."""

MOVEMENTS = 5
"""Movements that are remembered, the present one included: as many as a run of the paper has."""
SILENCE_S = 5.0
"""Without a reading for so long nothing is known of the present [s]; the bus of the ArmPi stalls
for 4 s."""


@dataclass(frozen=True)
class FleetPosterior(ArrayStruct):
    """What is believed of each robot.

    Attributes:
        posterior: (robot, hypothesis).
        judged: Whether anything was judged yet, (robot,).
        point: Where the tool was taken to rest after the present movement, (robot, axis) [m]; NaN
            if that movement does not count yet.
        dead: Robots whose tools stand still though they should move, (robot,).
        heard_s: When each last had a reading, whatever it was worth, (robot,) [s].
    """

    posterior: Annotated[FloatArray, Axes("run", "hypothesis")]
    judged: Annotated[BoolArray, Axes("run", empty=False)]
    point: Annotated[FloatArray, Axes("run", "axis", empty=np.nan)]
    dead: Annotated[BoolArray, Axes("run", empty=False)]
    heard_s: Annotated[FloatArray, Axes("run", empty=-np.inf)]


class StreamingFleet:
    """Streaming diagnosis of many robots of one kind.

    What counts are the last movements of a robot, older ones are forgotten. A movement counts from
    the first reading at rest after it; one without such a reading counts when the tool rests after
    the next. The answer is renewed when the tool is found to rest elsewhere than it was judged to.

    Args:
        diagnoser: The method, with its hypotheses and healthy behaviour.
        robots: How many robots there are.
        rate_hz: True rate of their tool sensors [Hz]; readings that come closer together than it
            says are taken for drawn out; None: all readings are real.
        movements: Movements that are remembered, the present one included.

    Raises:
        InputError: If there is no robot, no movement, or the rate is not above 0.
    """

    def __init__(
        self,
        diagnoser: BayesDiagnoser | RobotLike,
        robots: int,
        rate_hz: float | None = None,
        movements: int = MOVEMENTS,
    ) -> None:
        if not isinstance(diagnoser, BayesDiagnoser):
            diagnoser = BayesDiagnoser(diagnoser)
        motors = len(diagnoser.twin.robot.motors)
        if robots < 1 or movements < 1 or not (rate_hz is None or rate_hz > 0.0):
            raise InputError(
                f"a stream of {robots} robots, {movements} movements, {rate_hz} Hz. Expected one "
                "robot and one movement at least, and a rate above 0 or None."
            )
        model = self.model = diagnoser.healthy_model
        known = "+".join(model.sensing) in STREAMED
        if not known or (not model.sensors.tool_alone and diagnoser.whole_run):
            raise InputError(
                f"sensing {diagnoser.sensing}: a stream sees by {', '.join(STREAMED)}; with "
                "encoders, whole_run=False. Diagnose recorded runs, or leave sensing out."
            )
        self.diagnoser = diagnoser
        self.rounding: Rounding | None = None
        self.hypotheses = [str(hypothesis) for hypothesis in diagnoser.hypothesis_set]
        self.robots, self.rate_hz, self.movements = robots, rate_hz, movements
        self._zero = np.full(robots, np.nan)
        self._now = np.full(robots, -np.inf)
        self._settings = model.settings
        notes_way = diagnoser.uses_transients
        self._tracker = MovementTracker(model, robots, movements, rate_hz, notes_way)
        self._frozen = FrozenSensorDetector.empty(run=robots, axis=3, value=4, motor=motors)
        self._untold = UntoldMotion.empty(run=robots, axis=3)
        self._split = TwoPlaces.empty(run=robots, axis=3)
        self._prior = np.exp(log_prior(diagnoser.hypothesis_set, diagnoser.priors))
        channels = model.sensors.channels
        sizes = {"run": robots, "hypothesis": len(self._prior), "axis": channels}
        self._beliefs = FleetPosterior.empty(**sizes)
        self._beliefs.posterior[:] = self._prior
        self._everything_counts = any(shows_in_transients(h) for h in diagnoser.hypothesis_set)
        self._latest: dict[int, tuple[Posterior, int, StreamPosition]] = {}

    @property
    def time(self) -> float:
        """Newest time of the stream [s]."""
        return float(self.times.max())

    @property
    def times(self) -> FloatArray:
        """Newest time of each robot, (robot,) [s]; -inf before its first sample."""
        return self._now + np.nan_to_num(self._zero)

    @property
    def posterior(self) -> FloatArray:
        """What is believed, (robot, hypothesis); the prior where nothing is known yet."""
        return self._beliefs.posterior.copy()

    @property
    def judged(self) -> BoolArray:
        """Robots of which a movement was seen yet, (robot,)."""
        return self._beliefs.judged.copy()

    @property
    def stale(self) -> BoolArray:
        """Robots that have not been heard of for a while: nothing is known of their present."""
        heard_s = self._beliefs.heard_s
        return np.asarray(np.isinf(heard_s) | (heard_s < self._now - SILENCE_S))

    def update(
        self,
        time: ArrayLike,
        command: ArrayLike | None,
        measured: ArrayLike | None,
        position: ArrayLike | None = None,
        goal: ArrayLike | None = None,
    ) -> IntArray:
        """Take a sample and return the robots of which something new is believed, (robot,).

        Args:
            time: When it was taken [s], of all robots or of each, (robot,), by its own clock; NaN:
                there is none of this robot. A sample may come late, as long as its movement lasts.
            command: References of all motors, (robot, motor) [rad]; NaN or None: not known.
            measured: Tool positions, (robot, axis) [m]; NaN or None: no reading.
            position: What the motors report of themselves, (robot, motor) [rad], where it is
                believed; a reading counts where both are there.
            goal: Goals that the motors report to have received, (robot, motor) [rad], where they
                are believed.

        Raises:
            InputError: If the shapes do not fit, or a time is not finite or far older than the
                newest of its robot.
        """
        before = self._odd.copy(), self._beliefs.dead.copy()
        judged = self._judge(self.see(time, command, measured, position, goal))
        odd = (self._odd != before[0]).any(axis=0) | (self._beliefs.dead & ~before[1])
        return np.union1d(np.flatnonzero(odd), judged)

    def see(
        self,
        time: ArrayLike,
        command: ArrayLike | None,
        measured: ArrayLike | None,
        position: ArrayLike | None = None,
        goal: ArrayLike | None = None,
    ) -> IntArray:
        """Take a sample as `update` does, and return the robots to be judged anew, (robot,).

        These are found to rest elsewhere than they were judged to.
        """
        motors = len(self.diagnoser.twin.robot.motors)
        reference = self._rows(command, motors, "commands")
        points = self._rows(measured, 3, "readings")
        own = self._by_own_clock(time)
        heard_s, read = self._beliefs.heard_s, np.isfinite(points).all(axis=1)
        heard_s[read] = np.maximum(heard_s[read], own[read])
        points = self._alive(own, reference, points)
        split = self._split.see(points, self._settings.unmoved_m)
        points = np.where(split[:, None], np.nan, points)
        away = self._astray(own, reference, points)
        sensors = self.model.sensors
        points = sensors.reading(points, self._rows(position, motors, "motor readings"))
        begun, at_rest = self._tracker.take(own, reference, points, away)
        self._beliefs.point[begun] = np.nan
        if sensors.goals and goal is not None:
            told = self._tracker.see_goals(self._rows(goal, motors, "goals"))
            self._beliefs.point[told] = np.nan
        self._untold.begin(np.union1d(begun, np.flatnonzero(self._tracker.references.moved)))
        return self._with_news(at_rest)

    def _astray(self, time: FloatArray, reference: FloatArray, points: FloatArray) -> BoolArray:
        """Return tools that left where they rested without a command, (robot,)."""
        tracker, settings = self._tracker, self._settings
        told = (tracker.window.count > 0) | tracker.references.moved
        near_m = settings.same_place_m, settings.unmoved_m
        last = tracker.references.last
        known = np.isfinite(last[:, 0]) | np.isfinite(reference).all(axis=1)
        place = self.diagnoser.twin.path
        return self._untold.see(
            time,
            points,
            tracker.rest(),
            told,
            tracker.overdue(time),
            known,
            near_m,
            lambda some: place(last[some]),
        )

    @property
    def _odd(self) -> BoolArray:
        """Whether each robot moves without being told, or its readings are of two, (2, robot)."""
        return np.stack([self._untold.untold, self._split.split])

    def conclude(self) -> None:
        """Count all that has come, as if the stream were over: answers are those of recorded runs.

        What comes after it is a new beginning for the movement that was under way.
        """
        tracker = self._tracker
        tracker.find_movements(np.flatnonzero(tracker.references.moved))
        there = np.flatnonzero(tracker.window.count > 0)
        tracker.conclude(there)
        self._judge(there, _as_recorded)

    def diagnosis(
        self,
        robot: int,
        before: Diagnosis | None = None,
        told: tuple[FloatArray, FloatArray] | None = None,
    ) -> Diagnosis | None:
        """Return the diagnosis of a robot in words; None where nothing can be said yet.

        Args:
            robot: Its index.
            before: What was said of it before; of a fault that is older than what is remembered,
                the onset told then stands.
            told: Log probability of each hypothesis, (hypothesis,), and log density of each
                movement given those before it, (movement,), where more is known than the last
                movements say.
        """
        if not self._known(robot):
            return self._unseen(robot)
        found, at, position = self._found(robot)
        if told is not None:
            log_posterior, explained = told
            rows = np.tile(found.log_prior, (at + 1, 1))
            rows[at], explained = log_posterior, np.tile(explained, (at + 1, 1))
            found = replace(found, log_posterior=rows, explained=explained)
        place = replace(position, before=before)
        return found.to_diagnosis(at, f"robot {robot}", self._quality(robot), place=place)

    def _unseen(self, robot: int) -> Diagnosis | None:
        """Return why nothing can be said of a robot that was not judged; None: it is too early."""
        if not self._odd[:, robot].any() or self._tracker.window.count[robot] > 0:
            return None
        return self.undecided(robot, self._quality(robot).fatal)

    def undecided(self, robot: int, reason: str, known: Diagnosis | None = None) -> Diagnosis:
        """Return that nothing can be said of a robot's motors.

        Args:
            robot: Its index.
            reason: Why.
            known: What was said without that; its remarks on the readings stand.
        """
        prior = dict(zip(self.hypotheses, self._prior.tolist(), strict=True))
        nothing = Diagnosis(f"robot {robot}", prior, undecided=reason)
        if known is not None:
            nothing = replace(nothing, run=known.run, quality=known.quality)
        return worded(nothing, self.diagnoser.hypothesis_set)

    def seen(self, robot: int) -> tuple[RunLikelihood, StreamPosition] | None:
        """Return what the last movements of a robot say, and where they lie in the stream.

        None where nothing was judged yet.
        """
        if not self._known(robot):
            return None
        found, at, position = self._found(robot)
        return found.likelihood[at], position

    def weigh(self, robots: IntArray, model: HealthyModel) -> RunLikelihood:
        """Return what the last movements of some robots say by a model, a run each."""
        window = self._tracker.window
        settled, _ = window.evidence(robots)
        return RunLikelihood(settled, model, remembered=window.judge(robots, settled, model))

    def note_rest(self, robots: IntArray) -> None:
        """Take the last movements of some robots as judged, as they look by now.

        For a filter of all movements; what this stream itself believes is left as it was.
        """
        for robot in robots.tolist():
            self._tracker.see_on_way(robot, int(self._tracker.window.count[robot]) - 1)
        self._beliefs.judged[robots], self._latest = True, {}
        self._beliefs.point[robots] = self._resting(robots)

    @property
    def remembered(self) -> IntArray:
        """Movements that are remembered of each robot, (robot,)."""
        return self._tracker.window.count

    @property
    def forgotten(self) -> IntArray:
        """Movements before them, (robot,)."""
        return self._tracker.window.forgotten

    def trouble(self, robot: int) -> str:
        """Return why the readings of a robot say nothing of its motors; empty: they do."""
        return self._quality(robot).fatal

    def adopt(self, imperfections: Imperfections) -> None:
        """Judge by another healthy behaviour from now on, the last movements too."""
        self.diagnoser = replace(self.diagnoser, imperfections=imperfections)
        self._look_anew()

    def count_as_noise(self, rounding: Rounding) -> None:
        """Judge by a sensor that rounds like this from now on, the last movements too."""
        self.rounding = rounding
        self._look_anew()

    def _look_anew(self) -> None:
        self.model = rounded(self.diagnoser.healthy_model, self.rounding, None)
        self._tracker.adopt(self.model)
        self._latest = {}

    def _known(self, robot: int) -> bool:
        """Return whether anything can be said of a robot."""
        beliefs = self._beliefs
        known = beliefs.judged[robot] or beliefs.dead[robot] or self._odd[:, robot].any()
        return bool(known and self._tracker.window.count[robot] > 0)

    def _found(self, robot: int) -> tuple[Posterior, int, StreamPosition]:
        """Return the last judgement of a robot, its row in that, and where the robot was."""
        if robot not in self._latest:
            self._latest = {}
            self._remember(np.array([robot]), self._judgement(np.array([robot])))
        return self._latest[robot]

    def _quality(self, robot: int) -> LogQuality:
        """Return what keeps the readings of a robot from saying anything of its motors."""
        if self._beliefs.dead[robot]:
            return DEAD
        if self._split.split[robot]:
            return TWO
        return UNTOLD if self._untold.untold[robot] else LogQuality()

    def _remember(self, robots: IntArray, posterior_of_runs: Posterior) -> None:
        """Keep the last judgement, and where each robot then was, for whoever asks for words."""
        window = self._tracker.window
        begin = window.zero_s + np.nan_to_num(self._zero)
        for at, robot in enumerate(robots.tolist()):
            begin_s, older = float(begin[robot]), int(window.forgotten[robot])
            self._latest[robot] = posterior_of_runs, at, StreamPosition(begin_s, older)

    def _by_own_clock(self, time: ArrayLike) -> FloatArray:
        """Return the time of each robot since its first sample, (robot,) [s]; NaN: no sample.

        Small numbers are exact.
        """
        alone = isinstance(time, Real)
        if not (np.isfinite(time) if alone else np.shape(time) == (self.robots,)):
            raise InputError(
                f"a sample is of {time!r} s. Expected one finite number, or one of each robot."
            )
        at = np.full(self.robots, time) if alone else as_floats(time)
        there = np.isfinite(at)
        first = there & np.isnan(self._zero)
        self._zero[first] = at[first]
        own = np.where(there, at - self._zero, np.nan)
        old = own < self._now - KEEP_S
        if old.any():
            robot = int(np.argmax(old))
            raise InputError(
                f"a sample is of {at[robot]} s, but the newest is of {self.times[robot]} s. "
                f"Expected none older than {KEEP_S:g} s before the newest; where a clock was set, "
                "begin a new stream."
            )
        self._now = np.fmax(self._now, own)
        return own

    def state(self) -> dict[str, np.ndarray]:
        """Return all that the stream knows, by name; the first axis is the robot.

        What movements say is left out: it is computed anew.
        """
        found = {"zero": self._zero, "now": self._now} | self._tracker.samples.state()
        for name, part in self._parts.items():
            found |= part.to_arrays(name)
        return found

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over what `state` returned, of as many robots or of fewer: then of the first ones.

        Raises:
            KeyError: If something is missing.
            ValueError: If something is of another shape.
        """
        known = slice(0, len(state["zero"]))
        self._zero[known], self._now[known] = state["zero"], state["now"]
        self._latest = {}
        for name, part in self._parts.items():
            part[known].from_arrays(name, state)
        self._tracker.window.looks.clear()
        self._tracker.samples.restore(state)

    @property
    def _parts(self) -> dict[str, ArrayStruct]:
        """What is kept of each robot, by name."""
        return {
            "references": self._tracker.references,
            "window": self._tracker.window,
            "beliefs": self._beliefs,
            "frozen": self._frozen,
            "untold": self._untold,
            "split": self._split,
        }

    def _rows(self, values: ArrayLike | None, columns: int, what: str) -> FloatArray:
        """Return values with a row for each robot, (robot, column); NaN where there are none."""
        shape = self.robots, columns
        found = np.full(shape, np.nan) if values is None else as_floats(values)
        if found.shape != shape:
            raise InputError(
                f"{what} have shape {found.shape}. Expected {shape}, a row for each robot."
            )
        return found

    def _alive(self, time: FloatArray, command: FloatArray, points: FloatArray) -> FloatArray:
        """Return the readings without those of dead sensors.

        What such a sensor said before that was noticed is forgotten.
        """
        beliefs, last = self._beliefs, self._tracker.references.last
        read = np.asarray(np.isfinite(points).all(axis=1))
        known = np.where(np.isfinite(command), command, last)
        near_m = self._settings.nearly_still_m
        flickers = self.rounding is None
        still, alone = self._frozen.see(time, read, points, known, near_m, flickers)
        alone &= ~np.array(self._settings.idle_axes)
        still |= beliefs.dead & ~read
        died = still & ~beliefs.dead
        beliefs.dead[:] = still
        beliefs.posterior[died] = self._prior
        for robot in np.flatnonzero(died):
            self._tracker.spoil(int(robot), self._frozen.still_since(int(robot)))
        silent = still | alone.any(axis=1)
        return np.where(silent[:, None], np.nan, points)

    def _with_news(self, robots: IntArray) -> IntArray:
        """Return the robots whose tools rest elsewhere than they were judged to."""
        moved = np.abs(self._resting(robots) - self._beliefs.point[robots])
        return robots[~(moved < self._settings.update_m).all(axis=1)]

    def _resting(self, robots: IntArray) -> FloatArray:
        """Return where tools rest after the present movement, (robot, axis) [m]."""
        window = self._tracker.window
        return window.settled.point[robots, window.count[robots] - 1]

    def _judge(self, robots: IntArray, weigh: Weigh = compute_posterior) -> IntArray:
        """Renew what is believed of robots by what their last movements say."""
        if len(robots) == 0:
            return robots
        window, beliefs = self._tracker.window, self._beliefs
        for robot in robots:
            self._tracker.see_on_way(int(robot), int(window.count[robot]) - 1)
        # The way takes long to judge, so that robots of which it does not count are apart.
        on_way, self._latest = self._on_way(robots), {}
        for group in (robots[on_way], robots[~on_way]):
            if len(group) == 0:
                continue
            posterior_of_runs = self._judgement(group, weigh)
            for at, robot in enumerate(group):
                undecided = posterior_of_runs.undecided(at, LogQuality())
                beliefs.posterior[robot] = posterior_of_runs.posterior(at, undecided)
            self._remember(group, posterior_of_runs)
        beliefs.judged[robots] = True
        beliefs.point[robots] = self._resting(robots)
        return robots

    def _on_way(self, robots: IntArray) -> BoolArray:
        """Return of which robots readings on the way count, (robot,)."""
        window = self._tracker.window
        there = np.arange(self.movements) < window.count[robots, None]
        unseen = (there & ~window.settled.usable[robots]).any(axis=1)
        return np.asarray(self.diagnoser.uses_transients & (unseen | self._everything_counts))

    def _judgement(self, robots: IntArray, weigh: Weigh = compute_posterior) -> Posterior:
        diagnoser, window = self.diagnoser, self._tracker.window
        settled, transient = window.evidence(robots)
        counts = self._on_way(robots).any()
        moving = transient.where(diagnoser.transient_mask(settled.usable)) if counts else None
        model = self.model
        likelihoods = window.judge(robots, settled, model)
        likelihood = RunLikelihood(settled, model, moving, remembered=likelihoods)
        return weigh(likelihood, diagnoser.hypothesis_set, diagnoser.priors)


def _as_recorded(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> Posterior:
    """Weigh hypotheses as of recorded runs, which takes too long for every sample.

    Each robot has a sensor of its own.
    """
    robots = np.arange(len(likelihood.usable))
    alone = (likelihood.alike(robots[k : k + 1]) for k in robots)
    parts = [run_posterior(one, hypotheses, priors, in_doubt=False) for one in alone]
    return assembled(likelihood, parts, robots, np.zeros_like(robots))
