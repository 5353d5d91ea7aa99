"""Watching one robot at work: what is the case by all movements so far, and when to call somebody.

The last movements are seen and estimated as by `StreamingDiagnoser`; what is believed of the
faults comes from all movements so far (`FaultFilter`), the alarm from `AlarmRule`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.connection.links.base import OK, STALE, Answer
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.numerics import log_of
from failuretwin.core.types import as_floats
from failuretwin.decision.streaming.alarm_rule import AlarmRule
from failuretwin.decision.streaming.diagnoser import reference_of
from failuretwin.decision.streaming.fleet import StreamingFleet
from failuretwin.digital_model.calibrated_robot import HealthyLike, RobotLike
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.fault_filter import RATES, FaultFilter, FaultRates
from failuretwin.inference.run_likelihood import RunLikelihood


class FaultMonitor:
    """Watches one robot; times and samples as of `StreamingDiagnoser.update`.

    Args:
        diagnoser: The method, with its hypotheses and healthy behaviour.
        false_alarms_per_100h: False alarms that are allowed in 100 hours of work.
        rates: How often faults come and go.

    Raises:
        InputError: If the budget makes no sense, or a hypothesis cannot be followed.
    """

    def __init__(
        self,
        diagnoser: BayesDiagnoser,
        false_alarms_per_100h: float = 1.0,
        rates: FaultRates = RATES,
    ) -> None:
        self._fleet = StreamingFleet(diagnoser, 1)
        hypotheses = diagnoser.hypothesis_set
        self._filter = FaultFilter(diagnoser.healthy_model, hypotheses, diagnoser.priors, rates)
        self._rule = AlarmRule(
            self._fleet.hypotheses, self._filter.faults_per_h, false_alarms_per_100h
        )
        self._concluded = self._filter.begin(1)
        self._movements = 0
        self._window = 0, 0
        self._explained: dict[int, float] = {}
        self._diagnosis: Diagnosis | None = None

    def update(
        self,
        time: float,
        command: Mapping[str, float] | ArrayLike | None,
        measured: ArrayLike | None,
    ) -> Answer:
        """Take what is known at a time and return what is believed then.

        Args:
            time: Time of the stream [s]; a sample may come late, as long as its movement lasts.
            command: Reference of every motor, by name or (motor,) [rad]; None: not known.
            measured: Tool position, (axis,) [m]; None or NaN: no reading.

        Raises:
            InputError: If a motor is missing, shapes do not fit or the time is not finite.
        """
        motors = self._fleet.diagnoser.twin.robot.motor_names
        reference = None if command is None else reference_of(motors, command)[None]
        point = None if measured is None else as_floats(measured)[None]
        if len(self._fleet.update(time, reference, point)):
            self._judge()
        return self._answer()

    def conclude(self) -> Answer:
        """Count all that has come, as if the stream were over."""
        self._fleet.conclude()
        self._judge()
        return self._answer()

    def _answer(self) -> Answer:
        state = STALE if self._fleet.stale[0] else OK
        return Answer(self._fleet.time, state, self._diagnosis, self._rule.alarm)

    def _judge(self) -> None:
        """Renew what is believed by what the last movements say."""
        seen = self._fleet.seen(0)
        if seen is None:
            return
        posterior = self._followed(*seen)
        explained = np.array([self._explained.get(m, np.inf) for m in range(*self._window)])
        told = log_of(posterior), explained
        found = self._fleet.diagnosis(0, self._diagnosis, told)
        if found is not None:
            self._diagnosis = replace(found, run="stream")

    def _followed(self, likelihood: RunLikelihood, before: int) -> np.ndarray:
        """Return the probability of each hypothesis, (hypothesis,).

        Movements that are over are counted once and for all; the present one as it looks now.

        Args:
            likelihood: What the last movements say.
            before: How many there were before them.
        """
        count = likelihood.usable.shape[1]
        self._window = before, before + count
        self._explained = {m: v for m, v in self._explained.items() if m >= before}
        new = max(self._movements - before, 0)
        part = slice(max(new - 1, 0), count)
        evidence, findings = likelihood.evidence[:, part], likelihood.findings[:, part]
        some = RunLikelihood(evidence, likelihood.model, remembered=findings)
        says, belief, hours = self._filter.evidence(some), self._concluded, 0.0
        for movement in range(new, count):
            at = movement - part.start
            belief = self._filter.advance(belief, says, at)
            density = some.log_healthy[0, at] + belief.log_predictive[0]
            self._explained[before + movement] = float(density)
            if movement < count - 1:
                hours += float(says.hours[0, at])
                self._concluded, self._movements = belief, before + movement + 1
        posterior = self._filter.posterior(belief)[0]
        self._rule.see(self._fleet.time, posterior, hours)
        return posterior


def monitor(
    twin: RobotLike, imperfections: HealthyLike = None, false_alarms_per_100h: float = 1.0
) -> FaultMonitor:
    """Return what watches a robot at work: settled poses, and faults are rare.

    Args:
        twin: The robot: its twin, itself, its name or its profile.
        imperfections: How the healthy robot differs from it, or a calibration by name or path;
            None: as its profile says.
        false_alarms_per_100h: False alarms that are allowed in 100 hours of work.
    """
    return FaultMonitor(BayesDiagnoser(twin, imperfections, whole_run=False), false_alarms_per_100h)
