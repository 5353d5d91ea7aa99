"""What every movement says by itself: of a healthy robot, and of each motor alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.connection.healthy import HealthyModel
from failuretwin.connection.lost_commands import Alternatives
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.settled_evidence import SettledEvidence
from failuretwin.decision.evidence.motor_profile import MotorProfile, motor_profiles


@dataclass(frozen=True)
class Findings:
    """What every movement says by itself, whatever fault may have come later.

    Attributes:
        model: The healthy robot.
        alternatives: What may have become of each movement, given the movements before.
        density: Log density of its settled position under each alternative if no motor is faulty,
            (run, movement, alternative) [log 1/m3].
        poses: Pose that explains the settled position then, (run, movement, alternative, motor)
            [rad].
        profiles: What each movement says of each motor.
    """

    model: HealthyModel
    alternatives: Alternatives
    density: FloatArray
    poses: FloatArray
    profiles: Sequence[MotorProfile]

    @property
    def terms(self) -> FloatArray:
        """Log weight times density of each alternative, (run, movement, alternative)."""
        return self.alternatives.log_weight + self.density


def find(evidence: SettledEvidence, model: HealthyModel) -> Findings:
    """Return what every movement says by itself."""
    usual = model.alternatives(evidence.movements)
    density, poses = explained(evidence, model, usual)
    found = given_before(evidence, model, usual, density)
    profiles = motor_profiles(evidence, model, found, range(len(model.scatter)))
    return Findings(model, found, density, poses, profiles)


def explained(
    evidence: SettledEvidence, model: HealthyModel, alternatives: Alternatives
) -> tuple[FloatArray, FloatArray]:
    """Return how well each alternative explains the settled positions, as in `Findings`."""
    as_likely = replace(alternatives, log_weight=np.zeros_like(alternatives.log_weight))
    return model.explain(evidence, as_likely)


def given_before(
    evidence: SettledEvidence, model: HealthyModel, usual: Alternatives, density: FloatArray
) -> Alternatives:
    """Return alternatives with their probability given what was seen of the movements before.

    Args:
        evidence: Settled positions.
        model: The healthy robot.
        usual: What may have become of each movement, whatever was seen.
        density: How well that explains the settled positions.
    """
    return model.given_before(evidence, usual, usual.log_weight + density)
