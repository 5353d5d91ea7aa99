"""Faults of given sizes, tried out on some motions: by how much each is ahead of the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.hypothesis import Fault, Hypothesis
from failuretwin.core.types import FloatArray
from failuretwin.decision.telling_apart.separation import Judge
from failuretwin.failure_behavior.course import STEP
from failuretwin.failure_behavior.fault_value import FaultValue
from failuretwin.failure_behavior.modes.base import FaultMode
from failuretwin.failure_behavior.modes.registry import MODES
from failuretwin.failure_behavior.modes.sized import SizedMode

if TYPE_CHECKING:
    import xarray as xr

DRAWS = 8
"""Signs, and which movements are hit, are drawn this often at least, over all motions."""

Case = tuple[Hypothesis, float]
"""A hypothesis and the size of its fault; NaN where it has none."""


@dataclass(frozen=True)
class Trials:
    """Some motions to try faults on.

    Attributes:
        judge: Lays runs beside every hypothesis.
        motions: A run set of the motions, with a reading wherever the tool will be seen.
        onset_s: When faults begin [s].
    """

    judge: Judge
    motions: xr.Dataset
    onset_s: float

    def ahead(self, cases: Sequence[Case]) -> FloatArray:
        """Return by how much the truth beats each hypothesis, (case, hypothesis) [nats].

        It is the median over motions and draws.

        Args:
            cases: What is true, of the judge's hypotheses.
        """
        draws = [(case, draw) for case in cases for draw in range(self._draws(case))]
        rows = [draw % self.motions.sizes["run"] for _, draw in draws]
        faults = [self._faults(case, draw) for case, draw in draws]
        onset = np.full(len(draws), self.onset_s)
        fit = self.judge.fits(self.motions.isel(run=rows), faults, onset)
        own = [self.judge.hypotheses.index(case[0]) for case, _ in draws]
        ahead = fit[np.arange(len(own)), own][:, None] - fit
        ends = np.cumsum([self._draws(case) for case in cases])
        return np.array([np.median(part, axis=0) for part in np.split(ahead, ends[:-1])])

    def _draws(self, case: Case) -> int:
        motions = int(self.motions.sizes["run"])
        return motions if np.isnan(case[1]) else max(motions, DRAWS)

    def _faults(self, case: Case, draw: int) -> list[FaultValue]:
        """Return the faults of one draw; other sizes have the same luck."""
        rng = np.random.default_rng(draw)
        end = float(self.motions["time"].values[-1])
        count = int(self.motions.sizes["movement"])
        hypothesis, size = case
        return [
            self._mode(fault, size).draw(fault.motor, count, end, rng)
            for fault in hypothesis.faults
        ]

    def _mode(self, fault: Fault, size: float) -> FaultMode:
        """Return the mode with one size and one onset, there at once."""
        mode = MODES[fault.mode]
        mode = replace(mode, onset_s=(self.onset_s, self.onset_s))
        if STEP in mode.allowed_profiles:
            mode = replace(mode, profiles=(STEP,))
        return replace(mode, magnitude=(size, size)) if isinstance(mode, SizedMode) else mode
