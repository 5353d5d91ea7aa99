"""Diagnosis part by part: what all runs of a set share is judged once, by some of them.

Set-up, rounding and the place of the sensor are judged by a sample that does not grow with the set.
Each part is then diagnosed without any other run, so that memory does not grow either.

Section: docs/inference.md#set-ups
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.runs import truths_of
from failuretwin.core.types import IntArray
from failuretwin.inference.observation.evidence import TransientSamples
from failuretwin.inference.seen_runs import SeenRuns, common_remarks, mixed
from failuretwin.inference.set_up_posterior import SetUpPosterior

if TYPE_CHECKING:
    import xarray as xr

PART_RUNS = 128
"""Runs of a part; the most by which the set-up of a run set is judged."""
CHUNK_RUNS = 64
"""Runs of five movements at a time: keeps the work on nodes in about 100 MB."""


def parts_of(runs: int) -> list[range]:
    """Return the numbers of the runs in each part of a set of so many."""
    return [range(runs)[first : first + PART_RUNS] for first in range(0, runs, PART_RUNS)]


def spread(runs: int) -> IntArray:
    """Return the numbers of the runs by which the set-up is judged, evenly spread, (run,)."""
    return np.unique(np.linspace(0, runs - 1, min(PART_RUNS, runs)).astype(np.int64))


def runs_at_a_time(movements: int) -> int:
    """Return how many runs of so many movements to weigh at a time: nodes grow with the square."""
    return max(1, min(CHUNK_RUNS, 25 * CHUNK_RUNS // max(movements, 1) ** 2))


@dataclass(frozen=True)
class PreparedDiagnoser:
    """Diagnoser of the runs of one set; `BayesDiagnoser.prepare` returns one.

    Attributes:
        sample: Runs by which the set-up is judged, set up as told.
        moving: Returns the readings on the way that count; None: none do.
    """

    sample: SeenRuns
    moving: Callable[[SeenRuns], TransientSamples | None]

    @cached_property
    def set_ups(self) -> SetUpPosterior:
        """What is believed of the set-up."""
        return self.sample.set_ups()

    @cached_property
    def judges(self) -> Sequence[SeenRuns]:
        """The sample under each set-up."""
        return [self.sample.under(one.set_up.correction) for one in self.set_ups.found]

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the diagnosis of each run of a part of the set, or of the sample itself."""
        seen = self._seen(runs)
        moving = [self.moving(one) for one in seen]
        names, truth = [str(name) for name in runs["run"].values], truths_of(runs)
        results, quality = [], seen[0].evidence.quality
        rounding = seen[0].rounding()
        common = common_remarks(self.set_ups, rounding)
        chunk = runs_at_a_time(seen[0].settled.movements.start.shape[1])
        for first in range(0, len(names), chunk):
            rows = slice(first, first + chunk)
            says = [one.posterior(rows, way) for one, way in zip(seen, moving, strict=True)]
            likeliest = mixed(says, self.set_ups, rounding)
            robots = seen[0].robots(likeliest, common, self.set_ups.fits)
            for at in range(len(names))[rows]:
                posterior, row = robots.of_run(at - first)
                results.append(posterior.to_diagnosis(row, names[at], quality[at], truth[at]))
        return results

    def _seen(self, runs: xr.Dataset) -> Sequence[SeenRuns]:
        """Return runs of the set under each set-up."""
        if runs is self.sample.runs:
            return self.judges
        pairs = zip(self.judges, self.set_ups.found, strict=True)
        return [judge.part(one.set_up.correction.runs(runs)) for judge, one in pairs]
