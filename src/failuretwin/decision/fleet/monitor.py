"""Alarms of many robots of one kind: the filter and the rule of `watch`, in batches.

`StreamingFleet` finds the movements; `HealthyMixture` follows what all of them say; `AlarmRule`
decides. Nothing is learned of a robot and its set-up is not tested, as `watch` does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from failuretwin.core.config import from_table
from failuretwin.core.hypothesis import Alarm, Diagnosis
from failuretwin.core.numerics import log_of
from failuretwin.core.types import IntArray
from failuretwin.decision.streaming.alarm_rule import AlarmRule
from failuretwin.decision.streaming.fleet import StreamingFleet
from failuretwin.decision.streaming.monitor import candidates, evidence_since, mixture_of
from failuretwin.decision.streaming.set_up_watch import PROOF, is_held
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.movements.run_likelihood import RunLikelihood

RULE = ("hours", "passed", "unnamed")
"""What an alarm rule counts."""


class FleetMonitor:
    """Watches many robots of one kind; `fleet` takes their samples, and says whom to `judge`.

    Args:
        diagnoser: The method, settled poses alone (``whole_run=False``).
        robots: How many robots there are.
        false_alarms_per_100h: False alarms that are allowed in 100 hours of work, of each robot.
    """

    def __init__(
        self, diagnoser: BayesDiagnoser, robots: int, false_alarms_per_100h: float = 1.0
    ) -> None:
        self.diagnoser, self.budget = diagnoser, false_alarms_per_100h
        self.fleet = StreamingFleet(diagnoser, robots)
        self._models = candidates(diagnoser.healthy_model)
        self._mixture = mixture_of(self._models, diagnoser)
        self._concluded = self._mixture.begin(robots)
        self._present = self._mixture.begin(robots)
        self._movements = np.zeros(robots, dtype=np.int64)
        rates = self._mixture.filters[0].faults_per_h
        self._rules = [
            AlarmRule(self.fleet.hypotheses, rates, false_alarms_per_100h) for _ in range(robots)
        ]

    def judge(self, robots: IntArray) -> None:
        """Renew what is believed of some robots by what their last movements say.

        Robots with as many new movements are followed together.
        """
        self.fleet.note_rest(robots)
        says = [self.fleet.weigh(robots, model) for model in self._models]
        count, before = self.fleet.remembered[robots], self.fleet.forgotten[robots]
        new = np.maximum(self._movements[robots] - before, 0)
        for begin, end in np.unique(np.stack([new, count], axis=1), axis=0):
            rows = np.flatnonzero((new == begin) & (count == end))
            self._advance([one[rows] for one in says], robots[rows], int(begin), int(end))

    def alarm(self, robot: int) -> Alarm:
        """Return the alarm of a robot.

        Within its first movements an error is not blamed on a motor: a wrong zero looks the same.
        """
        alarm = self._rules[robot].alarm
        seen = self.fleet.forgotten[robot] + self.fleet.remembered[robot]
        withheld = seen <= PROOF and alarm.cause and not is_held(alarm.cause)
        return Alarm() if withheld else alarm

    def diagnosis(self, robot: int) -> Diagnosis | None:
        """Return the diagnosis of a robot in words; None where nothing can be said yet."""
        belief = self._present[robot : robot + 1]
        seen = self.fleet.seen(robot)
        if seen is None:
            return self.fleet.diagnosis(robot)
        shape = seen[0].usable.shape[1]
        told = log_of(self._mixture.posterior(belief)[0]), np.zeros(shape)
        return self.fleet.diagnosis(robot, told=told)

    def _advance(
        self, likelihoods: Sequence[RunLikelihood], robots: IntArray, begin: int, end: int
    ) -> None:
        """Follow the movements from `begin` to `end` of some robots; the last is the present one.

        Movements that are over are counted once and for all; the present one as it looks now.
        """
        says = [
            evidence_since(one, likelihood, begin)
            for one, likelihood in zip(self._mixture.filters, likelihoods, strict=True)
        ]
        belief, hours = self._concluded[robots], np.zeros(len(robots))
        for movement in range(begin, end):
            belief = self._mixture.advance(belief, says, movement - begin)
            if movement < end - 1:
                hours += says[0].hours[:, movement - begin]
                self._concluded.put(robots, belief)
                self._movements[robots] = self.fleet.forgotten[robots] + movement + 1
        self._present.put(robots, belief)
        posterior, times = self._mixture.posterior(belief), self.fleet.times
        for at, robot in enumerate(robots.tolist()):
            self._rules[robot].see(float(times[robot]), posterior[at], float(hours[at]))

    # State: arrays with a row for each robot, and the alarms as tables.

    def state(self) -> dict[str, np.ndarray]:
        """Return what is known of all robots, by name; the first axis is the robot.

        What `judge` computes again is left out, such as the belief in the present movement.
        """
        found = self.fleet.state() | {"movements": self._movements}
        return found | self._concluded.to_arrays("concluded")

    def alarms(self) -> list[dict[str, Any]]:
        """Return the alarm of each robot, and what its rule counts, as a table."""
        return [
            {"alarm": asdict(rule.alarm), **{name: getattr(rule, name) for name in RULE}}
            for rule in self._rules
        ]

    def restore(self, state: Mapping[str, np.ndarray], alarms: Sequence[Mapping[str, Any]]) -> None:
        """Take over what `state` and `alarms` returned of as many robots or fewer.

        Raises:
            KeyError: If something is missing.
            ValueError: If something is of another shape.
        """
        known = len(alarms)
        self.fleet.restore(state)
        self._movements[:known] = state["movements"]
        self._concluded[:known].from_arrays("concluded", state)
        for rule, table in zip(self._rules[:known], alarms, strict=True):
            rule.alarm = from_table(Alarm, table["alarm"], "alarm")
            for name in RULE:
                setattr(rule, name, table[name])
