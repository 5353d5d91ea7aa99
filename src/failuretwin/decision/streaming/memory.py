"""What past movements were found to say, kept so that only the present one is looked at anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.connection.healthy import Alternatives, HealthyModel
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.data_knowledge.settled_evidence import SettledEvidence
from failuretwin.decision.findings import Findings, find
from failuretwin.decision.motor_profile import MotorProfile
from failuretwin.decision.streaming.state import Arrays

PER_MOTOR = ("best", "precision", "square", "log_weight", "expected", "pose", "beside")
"""What is kept of each motor's profile."""


PER_MOVEMENT = ("base", "direction", "chance", "terms", "poses")
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
    like: Findings | None = None

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
        exists = evidence.movements.exists
        stale = np.nonzero(exists & ~self.fresh[robots, : exists.shape[1]])
        if len(stale[0]):
            found = _find_items(evidence, model, stale)
            self._store((robots[stale[0]], stale[1]), found)
        return self._recall(robots, evidence, model)

    def _store(self, at: tuple[IntArray, IntArray], found: Findings) -> None:
        kept = {
            "base": found.alternatives.base,
            "direction": found.alternatives.direction,
            "chance": found.alternatives.log_weight,
            "terms": found.terms,
            "poses": found.poses,
        }
        for name in PER_MOTOR:
            of_motors = [getattr(profile, name) for profile in found.profiles]
            kept[name] = np.stack(of_motors, axis=2)  # (item, 1, motor, ...)
        for name, values in kept.items():
            if name not in self.arrays:
                self.arrays[name] = np.zeros((*self.fresh.shape, *values.shape[2:]))
            self.arrays[name][at] = values[:, 0]
        self.fresh[at] = True
        self.like = found

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
        return Findings(model, alternatives, recalled["terms"], recalled["poses"], profiles)


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


def _find_items(
    evidence: SettledEvidence, model: HealthyModel, item: tuple[IntArray, ...]
) -> Findings:
    """Return what single movements say, as runs of one movement each."""
    whole = model.alternatives(evidence.movements)
    alone = Alternatives(
        whole.lost,
        *(values[item][:, None] for values in (whole.base, whole.direction, whole.log_weight)),
    )
    single = replace(
        evidence,
        point=evidence.point[item][:, None],
        usable=evidence.usable[item][:, None],
    )
    return find(single, model, alone)
