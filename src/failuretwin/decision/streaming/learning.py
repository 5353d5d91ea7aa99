"""What a watch learns of its robot as it goes: finished movements teach the life filter.

Movements are judged before they are learned from; what is suspected of a motor in a run teaches of
the others alone (`LifeFilter`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin.connection.tracked_diagnosis import begin, with_timing_of
from failuretwin.core.movements import Movements
from failuretwin.digital_model.nonidealities import Imperfections, Variation
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.evidence import SettledEvidence
from failuretwin.inference.healthy_model import HealthyModel

RUN = 5
"""Movements of a run that is learned from at first: as many as a run of the paper has."""
LONG_RUN = 20
"""The same once the robot is known a little: longer runs cost less time."""
LITTLE = 100
"""Movements from which it is."""
TIMED = 200
"""Latest movements whose commands tell how late this robot starts."""


class LifeLearner:
    """Learns of one robot from its movements, beginning with what arms of its kind are like.

    Args:
        diagnoser: The method, with its hypotheses and priors.
    """

    def __init__(self, diagnoser: BayesDiagnoser) -> None:
        self._life = begin(diagnoser, cold=True)
        self._waiting: list[SettledEvidence] = []
        self._told: Movements | None = None

    @property
    def model(self) -> HealthyModel:
        """The healthy robot as it is believed to be by now, with what is left of the doubt."""
        life = self._life
        if life.window is None:
            return life.model
        learned = life.learned
        _, (bias, compliance, friction) = life.offsets
        size = np.abs(np.asarray(learned.settling.compliance if learned.settling else 0.0))
        relative = np.divide(compliance, size, out=np.zeros_like(compliance), where=size > 1e-9)
        doubt = replace(
            learned.variation or Variation(),
            bias=tuple(bias.tolist()),
            compliance=tuple(np.minimum(relative, 1.0).tolist()),
            friction=tuple(friction.tolist()),
        )
        return replace(life.model, imperfections=replace(learned, variation=doubt))

    @property
    def movements(self) -> int:
        """Movements that were learned from."""
        return self._life.movements

    def take(self, movement: SettledEvidence) -> bool:
        """Take in a finished movement and return whether more is known now.

        Args:
            movement: A run of this movement alone.
        """
        self._waiting.append(movement)
        if len(self._waiting) < (RUN if self.movements < LITTLE else LONG_RUN):
            return False
        run = _joined(self._waiting)
        self._waiting = []
        if not run.usable.any():
            return False
        life, robot = self._life, self._life.model.twin.robot
        movements = run.movements
        self._told = movements if self._told is None else _followed_by(self._told, movements)
        now = with_timing_of(life.model.imperfections, self._told, robot)
        life.model = replace(life.model, imperfections=_learning(now))
        life.follow(run)
        return True


def _learning(now: Imperfections) -> Imperfections:
    """Return imperfections that say that runs taught them."""
    name = now.name if now.name.endswith("learned") else f"{now.name}, learned"
    return replace(now, name=name, protocol="P1")


def _joined(movements: list[SettledEvidence]) -> SettledEvidence:
    """Return movements one after the other as one run, its times from the first command."""
    run = movements[0].blank(1, len(movements))
    for at, movement in enumerate(movements):
        run.put((slice(0, 1), slice(at, at + 1)), movement)
    run.movements.initial[:] = movements[0].movements.initial
    return run


def _followed_by(before: Movements, after: Movements) -> Movements:
    """Return the movements of a robot with later ones behind them, the latest `TIMED`."""
    return Movements(
        before.initial,
        *(
            np.concatenate([getattr(before, name), getattr(after, name)], axis=1)[:, -TIMED:]
            for name in ("target", "ramp_duration", "start")
        ),
    )
