"""What every movement says by itself: of a healthy robot, and of each motor alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from failuretwin.connection.healthy import Alternatives, HealthyModel
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.settled_evidence import SettledEvidence
from failuretwin.decision.motor_profile import MotorProfile, motor_profiles


@dataclass(frozen=True)
class Findings:
    """What every movement says by itself, whatever the others say.

    Attributes:
        model: The healthy robot.
        alternatives: What may have become of each movement.
        terms: Log weight times density of each alternative if no motor is faulty,
            (run, movement, alternative) [log 1/m3].
        poses: Pose that explains the settled position then, (run, movement, alternative, motor)
            [rad].
        profiles: What each movement says of each motor.
    """

    model: HealthyModel
    alternatives: Alternatives
    terms: FloatArray
    poses: FloatArray
    profiles: Sequence[MotorProfile]


def find(
    evidence: SettledEvidence, model: HealthyModel, alternatives: Alternatives | None = None
) -> Findings:
    """Return what every movement says by itself.

    Args:
        evidence: Settled positions.
        model: The healthy robot.
        alternatives: What may have become of each movement; None: what its movements say.
    """
    if alternatives is None:
        alternatives = model.alternatives(evidence.movements)
    terms, poses = model.explain(evidence, alternatives)
    motors = range(len(model.scatter))
    profiles = motor_profiles(evidence, model, alternatives, motors)
    return Findings(model, alternatives, terms, poses, profiles)
