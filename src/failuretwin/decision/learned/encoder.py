"""From runs to what a network sees, by one of the named feature sets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from failuretwin.core.errors import unknown_name
from failuretwin.decision.learned.paper_features import augmented_features, original_features
from failuretwin.decision.learned.robust_features import (
    PER_MOTOR,
    SHARED,
    Expectation,
    RobustFeatures,
    expectation_of,
)
from failuretwin.decision.learned.signals import Signals
from failuretwin.digital_model.imperfections import NO_IMPERFECTIONS
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

FEATURE_SETS = ("original", "augmented", "robust")
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Encoder:
    """Turns runs into arrays for a network.

    Attributes:
        features: One of `FEATURE_SETS`: the paper's two, and the one for real robots.
        robot: The robot.
        expected: Healthy behaviour that the robust features compare with; None: that of the
            published twin. The paper's features know of none.
    """

    features: str
    robot: Robot
    expected: Expectation | None = None

    def __post_init__(self) -> None:
        if self.features not in FEATURE_SETS:
            raise unknown_name("feature set", self.features, FEATURE_SETS)

    @property
    def channels(self) -> int:
        """Channels of each point."""
        motors = len(self.robot.motors)
        robust = len(PER_MOTOR) * motors + len(SHARED)
        return {"original": motors + 3, "augmented": 6, "robust": robust}[self.features]

    @property
    def protocol(self) -> str:
        """How much real data the features have seen."""
        return "P0" if self.expected is None else self.expected.protocol

    def encode(self, signals: Signals) -> Floats:
        """Return what a network sees, (run, point, channel)."""
        if self.features == "robust":
            return self._robust(signals).astype(np.float32)
        twin = DigitalTwin(self.robot)
        make = original_features if self.features == "original" else augmented_features
        return make(twin, signals).astype(np.float32)

    @cached_property
    def _robust(self) -> RobustFeatures:
        expected = self.expected or expectation_of(self.robot, NO_IMPERFECTIONS)
        return RobustFeatures(self.robot, expected)
