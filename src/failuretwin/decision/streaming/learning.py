"""What a watch learns of its robot as it goes: finished movements teach the life filter.

One begins with what arms of its kind are like, another with the calibration that was given.

Movements are judged before they are learned from; what is suspected of a motor in a run teaches of
the others alone (`LifeFilter`).
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Protocol

import numpy as np

from failuretwin.connection.population import stated_variation
from failuretwin.connection.self_calibration import with_timing_of
from failuretwin.connection.tracked_diagnosis import begin
from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.set_ups.setup_prior import SetupPrior
from failuretwin.inference.together.life_filter import LifeFilter
from failuretwin.inference.together.wear_limits import WearLimits

RUN = 5
"""Movements of a run that is learned from at first: as many as a run of the paper has."""
LONG_RUN = 20
"""The same of a robot without calibration that is known a little: longer runs cost less time."""
LITTLE = 100
"""Movements from which it is."""
TIMED = 200
"""Latest movements whose commands tell how late this robot starts."""
WARMING = WearLimits(rate=0.1, reach=4.0)
"""How fast and how far zeros of a calibrated robot may move: by some scatters in 20 minutes, as an
arm warms up; assumed. No fault that a watch looks for grows so."""


class LifeMemory(Protocol):
    """Keeps what watches learn of a robot from watch to watch."""

    def resumed(self, start: LifeFilter) -> LifeFilter:
        """Return what earlier watches have learned, given what arms of its kind are like."""
        ...

    def learned(self, life: LifeFilter) -> None:
        """Take what is believed after another run; it changes later."""
        ...


class LifeLearner:
    """Learns of one robot from its movements.

    It begins with what arms of its kind are like (`cold`), or with the calibration. The frame of
    the sensor is taken to be as the profile says. A run is worked on in a thread of its own, so
    that answers need not wait; what it taught is known when the next run is complete, however fast
    time passes. What is learned is kept by `memory`; None: it is not kept.
    """

    def __init__(
        self,
        diagnoser: BayesDiagnoser,
        memory: LifeMemory | None = None,
        cold: bool = True,
    ) -> None:
        known = replace(diagnoser.priors, setup=SetupPrior.known())
        self._diagnoser = replace(diagnoser, priors=known)
        self._memory = memory
        self._cold = cold
        start = self._start()
        self._life = start if memory is None else memory.resumed(start)
        self._waiting: list[SettledEvidence] = []
        self._told: Movements | None = None
        self._worker = ThreadPoolExecutor(1, "learning")
        self._work: Future[None] | None = None
        self.movements = self._life.movements
        self.model = as_watched(self._life) if self.movements else self._life.model

    def _start(self) -> LifeFilter:
        return begin(self._diagnoser, self._cold, None if self._cold else WARMING)

    @property
    def life(self) -> LifeFilter:
        """What is believed by now, once the last run is learned."""
        self._finish()
        return self._life

    def take(self, movement: SettledEvidence, learns: bool) -> bool:
        """Take in a finished movement and return whether the model has changed.

        The movement is a run by itself, by the time of the stream. One that is not worth learning
        is remembered for a while.
        """
        self._waiting.append(movement)
        run = LONG_RUN if self._cold and self.movements >= LITTLE else RUN
        if len(self._waiting) < run:
            return False
        if not learns:
            self._waiting = self._waiting[1:]
            return False
        taught = self._finish()
        if taught and self._memory is not None:
            self._memory.learned(self._life)
        first, *others = self._waiting
        seen, self._waiting = first.extended_by(*others), []
        told = seen.movements
        self._told = told if self._told is None else self._told.extended_by(told)
        self._told = self._told[:, -TIMED:]
        if seen.usable.any():
            self._work = self._worker.submit(self._follow, seen, _from_zero(self._told))
        return taught

    def _finish(self) -> bool:
        """Wait until the last run is learned and return whether there was one."""
        if self._work is None:
            return False
        work, self._work = self._work, None
        try:
            work.result()
            self.movements, self.model = self._life.movements, as_watched(self._life)
        except (InputError, np.linalg.LinAlgError):
            # What was learned makes no sense. What was believed before counts on, and all begins
            # anew: a watch must not end because of what it learns.
            self._life, self._told, self.movements = self._start(), None, 0
            return False
        return True

    def _follow(self, run: SettledEvidence, told: Movements) -> None:
        life, known = self._life, self._life.model.imperfections
        if self._cold:  # a calibration knows the timing from more movements
            known = with_timing_of(known, told, life.model.twin.robot)
        life.model = replace(life.model, imperfections=_learning(known))
        life.follow(replace(run, movements=_from_zero(run.movements)))


def as_watched(life: LifeFilter) -> HealthyModel:
    """Return the robot as a life believes it to be by now, with what is left of the doubt.

    A life fits one tail to all motors together. What several scatter in one movement is nearer to a
    normal than what each does, and a watch must know how far one motor scatters by itself: its tail
    is at least as heavy as usual of the kind.
    """
    learned, usual = life.learned, replace(life.model, imperfections=life.begun).settling
    _, deviation = life.offsets
    settling = replace(life.model, imperfections=learned).settling
    alone = replace(settling, tail_dof=min(settling.tail_dof, usual.tail_dof))
    doubt = stated_variation(deviation, settling, learned.variation)
    known = replace(learned, settling=alone, variation=doubt)
    return replace(life.model, imperfections=known)


def _learning(now: Imperfections) -> Imperfections:
    """Return imperfections that say that runs taught them."""
    name = now.name if now.name.endswith("learned") else f"{now.name}, learned"
    return replace(now, name=name, protocol="P1")


def _from_zero(movements: Movements) -> Movements:
    """Return movements with times from the first command on."""
    return replace(movements, start=movements.start - movements.start[:, :1])
