"""Streaming diagnosis of many robots of one kind at once, as arrays.

A sample is taken in three steps: references are followed until a movement can be named; readings
at rest say where the tool settled after it; where that is new, the robot is judged anew by what
its last movements say, with the same arithmetic as a recorded run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.core.diagnosis import Diagnosis
from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.data_knowledge.log_quality import LogQuality
from failuretwin.data_knowledge.moving_evidence import spread_out
from failuretwin.data_knowledge.settled_evidence import JUST_AFTER_S, rest, rest_begin
from failuretwin.decision.bayes import BayesDiagnoser
from failuretwin.decision.judgement import Judgement, judge
from failuretwin.decision.scene import Scene
from failuretwin.decision.streaming.memory import Memory
from failuretwin.decision.streaming.reference import References
from failuretwin.decision.streaming.samples import Samples
from failuretwin.decision.streaming.windows import Windows
from failuretwin.decision.weighing import log_prior, shows_on_way

MOVEMENTS = 5
"""Movements that are remembered, the present one included: as many as a run of the paper has."""
NEWS_M = 0.0005
"""A tool that rests this near to where it was judged to rest is not judged anew [m]: a tenth of
what a healthy one scatters."""
SILENCE_S = 5.0
"""Without a reading for so long nothing is known of the present [s]; the bus of the ArmPi stalls
for 4 s."""


@dataclass
class Beliefs:
    """What is believed of each robot.

    Attributes:
        posterior: (robot, hypothesis).
        judged: Whether anything was judged yet, (robot,).
        point: Where the tool was taken to rest after the present movement, (robot, axis) [m]; NaN
            if that movement does not count yet.
        read_s: Time of the newest reading, (robot,) [s].
    """

    posterior: FloatArray
    judged: BoolArray
    point: FloatArray
    read_s: FloatArray


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
        movements: Movements that are remembered.
    """

    def __init__(
        self,
        diagnoser: BayesDiagnoser,
        robots: int,
        rate_hz: float | None = None,
        movements: int = MOVEMENTS,
    ) -> None:
        motors = len(diagnoser.twin.robot.motors)
        self.diagnoser = diagnoser
        self.hypotheses = [str(hypothesis) for hypothesis in diagnoser.considered]
        self.time = -np.inf
        self._shape = (robots, motors)
        self._least_step = 0.0 if rate_hz is None else 0.9 / rate_hz
        self._samples = Samples(robots, motors)
        self._references = References.unknown(robots, motors)
        self._windows = Windows.empty(robots, movements, motors)
        prior = np.exp(log_prior(diagnoser.considered))
        self._beliefs = Beliefs(
            posterior=np.tile(prior, (robots, 1)),
            judged=np.zeros(robots, dtype=bool),
            point=np.full((robots, 3), np.nan),
            read_s=np.full(robots, -np.inf),
        )
        self._memory = Memory.empty(robots, movements)
        self._everything_counts = any(shows_on_way(h) for h in diagnoser.considered)
        self._latest: tuple[IntArray, Judgement] | None = None

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
        """Robots that have not been seen for a while: nothing is known of their present."""
        return self._beliefs.read_s < self.time - SILENCE_S

    def update(
        self, time: float, command: ArrayLike | None, measured: ArrayLike | None
    ) -> IntArray:
        """Take a sample and return the robots that were judged anew, (judged,).

        Args:
            time: When it was taken [s]; a sample may come late, as long as its movement lasts.
            command: References of all motors, (robot, motor) [rad]; NaN or None: not known.
            measured: Tool positions, (robot, axis) [m]; NaN or None: no reading.

        Raises:
            InputError: If the shapes do not fit or the time is not finite.
        """
        reference, points = self._checked(time, command, measured)
        self.time = max(self.time, time)
        self._samples.add(time, reference, points)
        for robot in self._references.see(time, reference):
            self._find_movements(int(robot))
        read = np.flatnonzero(np.isfinite(points).all(axis=1))
        if len(read) == 0:
            return read
        self._beliefs.read_s[read] = np.maximum(self._beliefs.read_s[read], time)
        return self._judge(self._with_news(self._look(read)))

    def conclude(self) -> None:
        """Count all that has come: from now on answers are those of the recorded runs."""
        for robot in np.flatnonzero(self._references.moved):
            self._find_movements(int(robot))
        there = np.flatnonzero(self._windows.count > 0)
        self._look(there[np.isfinite(self._beliefs.read_s[there])])
        for robot in there:
            self._see_on_way(int(robot), int(self._windows.count[robot]) - 1)
        self._judge(there)

    def diagnosis(self, robot: int) -> Diagnosis | None:
        """Return the diagnosis of a robot in words; None before its first movement.

        Args:
            robot: Its index.
        """
        if not self._beliefs.judged[robot]:
            return None
        if self._latest is None or robot not in self._latest[0]:
            self._latest = np.array([robot]), self._judgement(np.array([robot]))
        robots, judgement = self._latest
        at = int(np.flatnonzero(robots == robot)[0])
        return judgement.conclude(at, f"robot {robot}", LogQuality())

    def _checked(
        self, time: float, command: ArrayLike | None, measured: ArrayLike | None
    ) -> tuple[FloatArray, FloatArray]:
        robots, motors = self._shape
        reference = np.full((robots, motors), np.nan) if command is None else as_floats(command)
        points = np.full((robots, 3), np.nan) if measured is None else as_floats(measured)
        if reference.shape != (robots, motors) or points.shape != (robots, 3):
            raise InputError(
                f"a sample has commands {reference.shape} and readings {points.shape}. Expected "
                f"({robots}, {motors}), a row for each robot, and ({robots}, 3)."
            )
        if not np.isfinite(time):
            raise InputError(f"a sample is of {time} s. Expected a finite time.")
        return reference, points

    def _find_movements(self, robot: int) -> None:
        """Add the movements of a reference that has come to rest."""
        movements, windows = self._references.movements(robot, self._samples), self._windows
        if windows.count[robot] == 0 and movements.start.size:
            windows.zero_s[robot] = self._samples.time[0]
        for number, start in enumerate(movements.start[0]):
            if windows.count[robot] > 0:
                self._close(robot, start)
            if windows.full(robot):
                windows.forget_oldest(robot)
                self._memory.forget_oldest(robot)
            windows.append(robot, movements, number)
            self._beliefs.point[robot] = np.nan

    def _close(self, robot: int, end: float) -> None:
        """Say where the tool came to rest after the present movement, which the next one ends."""
        robots, place = np.array([robot]), self._windows.count[robot] - 1
        self._settle(robots, np.array([end]))
        self._see_on_way(robot, int(place))

    def _look(self, robots: IntArray) -> IntArray:
        """See where tools rest now and return those that do."""
        some = robots[self._windows.count[robots] > 0]
        return self._settle(some, self._beliefs.read_s[some] + JUST_AFTER_S)

    def _settle(self, robots: IntArray, end: FloatArray) -> IntArray:
        """See where tools rest after present movements that end, and return those that do.

        Args:
            robots: Indices, (item,).
            end: Ends of the plateaus, (item,) [s].
        """
        windows = self._windows
        place = windows.count[robots] - 1
        at = robots, place
        begin = rest_begin(windows.start[at], windows.ramp_duration[at], end)
        windows.begin[at], windows.end[at] = begin, end
        self._memory.fresh[at] = False
        over = begin < end
        robots, place, begin, end = robots[over], place[over], begin[over], end[over]
        if len(robots) == 0:
            return robots
        samples, time = self._samples, self._samples.time
        some = samples.since(float(begin.min()))
        inside = (time[some] >= begin[:, None]) & (time[some] < end[:, None] - 1e-9)
        found = rest(samples.measured[some, robots].swapaxes(0, 1), inside)
        windows.settle(robots, place, end, found)
        return robots[found.usable]

    def _see_on_way(self, robot: int, place: int) -> None:
        """Note what was read on the way of a movement, until the tool rested."""
        windows, samples = self._windows, self._samples
        at = robot, place
        until = windows.begin[at] if windows.usable[at] else windows.end[at]
        some = samples.since(float(windows.start[at]))
        time, point = samples.time[some], samples.measured[some, robot]
        there = np.isfinite(point).all(axis=1) & (time < until - 1e-9)
        time, point = time[there], point[there]
        chosen = spread_out(time, self._least_step)
        windows.see_on_way(robot, place, time[chosen], point[chosen])

    def _with_news(self, robots: IntArray) -> IntArray:
        """Return the robots whose tools rest elsewhere than they were judged to."""
        place = self._windows.count[robots] - 1
        off = np.abs(self._windows.point[robots, place] - self._beliefs.point[robots])
        near = (off < NEWS_M).all(axis=1)
        return robots[~near]

    def _judge(self, robots: IntArray) -> IntArray:
        """Renew what is believed of robots by what their last movements say."""
        windows, beliefs = self._windows, self._beliefs
        for robot in robots:
            self._see_on_way(int(robot), int(windows.count[robot]) - 1)
        unseen = np.arange(windows.start.shape[1]) < windows.count[robots, None]
        unseen &= ~windows.usable[robots]
        on_way = unseen.any(axis=1) | self._everything_counts
        for group in (robots[on_way], robots[~on_way]):
            if len(group) == 0:
                continue
            judgement = self._judgement(group)
            for at, robot in enumerate(group):
                undecided = judgement.undecided(at, LogQuality())
                beliefs.posterior[robot] = judgement.posterior(at, undecided)
            self._latest = group, judgement
        beliefs.judged[robots] = True
        beliefs.point[robots] = windows.point[robots, windows.count[robots] - 1]
        return robots

    def _judgement(self, robots: IntArray) -> Judgement:
        diagnoser = self.diagnoser
        evidence, moving = self._windows.evidence(robots), None
        if diagnoser.looks_on_way:
            seen = diagnoser.on_way(evidence.usable)
            moving = self._windows.on_way(robots).where(seen)
        model = diagnoser.healthy_model
        findings = self._memory.findings(robots, evidence, model)
        scene = Scene(evidence, model, moving, remembered=findings)
        return judge(scene, diagnoser.considered, diagnoser.priors)
