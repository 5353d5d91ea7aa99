"""What past movements were found to say, kept so that only the present one is looked at anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.connection.healthy import HealthyModel
from failuretwin.connection.lost_commands import Alternatives
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.data_knowledge.settled_evidence import SettledEvidence
from failuretwin.decision.evidence.findings import Findings, explained, find, given_before
from failuretwin.decision.evidence.motor_profile import MotorProfile, motor_profiles
from failuretwin.decision.streaming.state import Arrays

PER_MOTOR = ("best", "precision", "square", "log_weight", "expected", "pose", "beside")
"""What is kept of each motor's profile."""


PER_MOVEMENT = ("base", "direction", "chance", "density", "poses")
"""What is kept of each movement beside."""


@dataclass
class Memory:
    """Findings of the last movements of many robots.

    Attributes:
        fresh: Movements whose findings are up to date, (robot, movement).
        arrays: What is kept, by name: (robot, movement, ...); of profiles
            (robot, movement, motor, ...). Empty before the first look.
        like: Findings of any movements, for all that is the same for all of them.
    """

    fresh: BoolArray
    arrays: dict[str, FloatArray] = field(default_factory=dict)
    like: Findings | None = field(default=None, metadata={"saved": False})

    @classmethod
    def empty(cls, robots: int, movements: int) -> Memory:
        """Return a memory of nothing yet."""
        return cls(np.zeros((robots, movements), dtype=bool))

    def restore(self, arrays: Arrays) -> None:
        """Take over arrays of another memory, by ``memory/name``."""
        self.fresh = arrays["memory/fresh"].copy()
        names = [n for n in (*PER_MOVEMENT, *PER_MOTOR) if f"memory/{n}" in arrays]
        self.arrays = {name: arrays[f"memory/{name}"].copy() for name in names}

    def forget_oldest(self, robot: int) -> None:
        """Drop the oldest movement of a robot."""
        for values in self.arrays.values():
            values[robot, :-1] = values[robot, 1:].copy()
        self.fresh[robot, :-1] = self.fresh[robot, 1:].copy()
        self.fresh[robot, -1] = False

    def findings(
        self, robots: IntArray, evidence: SettledEvidence, model: HealthyModel
    ) -> Findings:
        """Return what the last movements of some robots say, looking at what is not fresh.

        Args:
            robots: Their indices, (run,).
            evidence: Where their tools settled.
            model: The healthy robot.
        """
        usual = model.alternatives(evidence.movements)
        exists = evidence.movements.exists
        stale = np.nonzero(exists & ~self.fresh[robots, : exists.shape[1]])
        at = robots[stale[0]], stale[1]
        if len(stale[0]):
            single, alone = _of_items(evidence, usual, stale)
            density, poses = explained(single, model, alone)
            self._put(at, density=density, poses=poses, base=alone.base, direction=alone.direction)
            known = self.arrays["density"][robots, : exists.shape[1]]
            weighed = given_before(evidence, model, usual, known)
            alone = replace(alone, log_weight=weighed.log_weight[stale][:, None])
            profiles = motor_profiles(single, model, alone, range(len(model.scatter)))
            self._put(at, chance=alone.log_weight, **_together(profiles))
            self.like = Findings(model, alone, density, poses, profiles)
            self.fresh[at] = True
        return self._recall(robots, evidence, model)

    def _put(self, at: tuple[IntArray, IntArray], **values: FloatArray) -> None:
        """Keep values of single movements, (item, 1, ...)."""
        for name, value in values.items():
            if name not in self.arrays:
                self.arrays[name] = np.zeros((*self.fresh.shape, *value.shape[2:]))
            self.arrays[name][at] = value[:, 0]

    def _recall(self, robots: IntArray, evidence: SettledEvidence, model: HealthyModel) -> Findings:
        some = robots, slice(0, evidence.usable.shape[1])
        recalled = {name: values[some] for name, values in self.arrays.items()}
        like = self.like = self.like or find(evidence[:0], model)
        profiles = [
            _profile(profile, {n: recalled[n][:, :, motor] for n in PER_MOTOR}, evidence.usable)
            for motor, profile in enumerate(like.profiles)
        ]
        alternatives = replace(
            like.alternatives,
            base=recalled["base"],
            direction=recalled["direction"],
            log_weight=recalled["chance"],
        )
        return Findings(model, alternatives, recalled["density"], recalled["poses"], profiles)


def _profile(
    like: MotorProfile, recalled: Mapping[str, FloatArray], usable: BoolArray
) -> MotorProfile:
    return replace(
        like,
        best=recalled["best"],
        precision=recalled["precision"],
        square=recalled["square"],
        log_weight=recalled["log_weight"],
        expected=recalled["expected"],
        pose=recalled["pose"],
        beside=recalled["beside"],
        usable=usable,
    )


def _together(profiles: Sequence[MotorProfile]) -> dict[str, FloatArray]:
    """Return what is kept of profiles, (item, 1, motor, ...), by name."""
    return {
        name: np.stack([getattr(profile, name) for profile in profiles], axis=2)
        for name in PER_MOTOR
    }


def _of_items(
    evidence: SettledEvidence, alternatives: Alternatives, item: tuple[IntArray, ...]
) -> tuple[SettledEvidence, Alternatives]:
    """Return single movements as runs of one movement each."""
    single = replace(
        evidence,
        point=evidence.point[item][:, None],
        usable=evidence.usable[item][:, None],
    )
    alone = replace(
        alternatives,
        base=alternatives.base[item][:, None],
        direction=alternatives.direction[item][:, None],
        log_weight=alternatives.log_weight[item][:, None],
    )
    return single, alone
