"""Input of the motor-wise network: what each moment of a run says of each motor.

A token is a moment and a motor. For each the engine's moments give the turn of this motor alone
that explains where the tool was seen, its precision and what is left,

    t = argmin r(t)^T S^-1 r(t),    P = J^T S^-1 J,    S = J diag(s^2) J^T + sn^2 I

under the likeliest outcome of the commands; what a lost command of the motor leaves; how well one
angle explains all moments from this one on; and travel and times. Angles and distances are in units
of their deviation, so that arms of any size look alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray

from failuretwin.core.types import ArrayStruct, Axes, BoolArray, FloatArray, IntArray
from failuretwin.decision.learned.moment_features import MomentFeatures
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.inference.engine.moments import Moments, moments_of
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.seen_runs import SeenRuns

if TYPE_CHECKING:
    import xarray as xr

Floats = NDArray[np.float32]

PLATEAU_BINS, RAMP_BINS = 4, 8
"""Bins of the onset before each moment: while the motor rests, and on its ramp."""
BINS = PLATEAU_BINS + RAMP_BINS


@dataclass(frozen=True)
class Tokens(ArrayStruct):
    """Runs as the network takes them.

    Attributes:
        features: (run, moment, motor, feature).
        exists: Moments that there are, (run, moment); others pad short runs.
        anchor: Angle that explains the moments from each on, its deviation, the logarithm of their
            rms turn and the sign of their mean turn, (run, moment, motor, 4).
        edges: Times between the bins of the onset, (run, moment, motor, bin + 1) [s].
    """

    features: Annotated[Floats, Axes("run", "moment", "motor", "feature")]
    exists: Annotated[BoolArray, Axes("run", "moment", empty=False)]
    anchor: Annotated[Floats, Axes("run", "moment", "motor", "part")]
    edges: Annotated[Floats, Axes("run", "moment", "motor", "edge")]

    def __len__(self) -> int:
        """How many runs."""
        return len(self.exists)

    @property
    def lengths(self) -> IntArray:
        """Moments of each run, (run,)."""
        return np.asarray(self.exists.sum(axis=1))

    def cut(self) -> Tokens:
        """Return the same without room that no run needs."""
        most = int(self.lengths.max(initial=1))
        return self._with(lambda values, axes: values[:, :most])

    def padded(self, moments: int) -> Tokens:
        """Return the same with room for so many moments."""
        more = moments - self.exists.shape[1]
        if more <= 0:
            return self
        room = [(0, 0), (0, more), (0, 0), (0, 0)]
        return self._with(lambda values, axes: np.pad(values, room[: values.ndim]))

    @classmethod
    def joined(cls, parts: Sequence[Tokens], along: str = "run") -> Tokens:
        """Return the runs of several sets, the shorter ones padded."""
        most = max(part.exists.shape[1] for part in parts)
        return super().joined([part.padded(most) for part in parts], along)


@dataclass(frozen=True)
class MomentEncoder(CalibratedRobot):
    """Turns runs of a robot, with what is known of its healthy behaviour, into tokens."""

    @cached_property
    def model(self) -> HealthyModel:
        """The healthy robot."""
        return HealthyModel.of(self)

    def encode(self, runs: xr.Dataset) -> Tokens:
        """Return the tokens of runs; reads `command` and `measured` alone."""
        seen = SeenRuns(runs, self.model, (), Priors())
        moments = moments_of(self.model, seen.settled)
        return tokens_of(MomentFeatures(self.model, moments))


def tokens_of(found: MomentFeatures) -> Tokens:
    """Return the tokens of some moments."""
    moments = found.moments
    features = np.stack([motor.features for motor in found.motors], axis=2)
    shared = np.repeat(found.shared[:, :, None], features.shape[2], axis=2)
    return Tokens(
        np.concatenate([features, shared], axis=-1).astype(np.float32),
        np.asarray((moments.ramp > 0.0).any(axis=-1) | moments.usable),
        np.stack([motor.anchor for motor in found.motors], axis=2).astype(np.float32),
        onset_edges(found.model, moments).astype(np.float32),
    )


def onset_edges(model: HealthyModel, moments: Moments) -> FloatArray:
    """Return the times between bins of the onset, (run, moment, motor, bin + 1) [s]."""
    begin = (moments.start + model.lag_s)[..., None] + np.zeros_like(moments.ramp)
    end = begin + moments.ramp * (1.0 - model.shortening)
    last = np.concatenate([np.zeros_like(end[:, :1]), end[:, :-1]], axis=1)
    last = np.maximum.accumulate(last, axis=1)
    begin = np.maximum(begin, last)
    end = np.maximum(end, begin)
    rest = np.linspace(0.0, 1.0, PLATEAU_BINS + 1)
    first = np.r_[0.0, np.linspace(0.0, 1.0, PLATEAU_BINS)]  # there before the run
    shares = np.where((np.arange(begin.shape[1]) == 0)[:, None], first, rest)[None, :, None]
    resting = last[..., None] + (begin - last)[..., None] * shares
    ramp = np.linspace(0.0, 1.0, RAMP_BINS + 1)[1:]
    return np.concatenate([resting, begin[..., None] + (end - begin)[..., None] * ramp], -1)
