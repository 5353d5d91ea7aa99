"""What kind of runs a network has learned from, and what to say of others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from failuretwin.core.diagnosis import Diagnosis
from failuretwin.core.movements import find_movements
from failuretwin.core.types import IntArray
from failuretwin.decision.learned.signals import signals_of

if TYPE_CHECKING:
    import xarray as xr


def movement_counts(runs: xr.Dataset) -> IntArray:
    """Return the number of movements of each run, (run,)."""
    signals = signals_of(runs)
    return find_movements(signals.command, signals.time).exists.sum(axis=1)


def movement_range(runs: xr.Dataset) -> tuple[int, int]:
    """Return the fewest and the most movements of a run."""
    counts = movement_counts(runs)
    return int(counts.min()), int(counts.max())


def with_doubt(
    diagnoses: Sequence[Diagnosis], movements: IntArray, known: tuple[int, int] | None
) -> list[Diagnosis]:
    """Return diagnoses with a remark on runs such as the network has not learned from.

    Args:
        diagnoses: Of each run.
        movements: How many movements each run has, (run,).
        known: Fewest and most movements of a run that it learned from; None: not known.
    """
    if known is None:
        return list(diagnoses)
    low, high = known
    told = f"{low}" if low == high else f"{low} to {high}"
    return [
        diagnosis
        if low <= count <= high
        else replace(
            diagnosis,
            quality=(
                *diagnosis.quality,
                f"{count} movements, and the network learned from runs of {told}: its "
                "probabilities mean little here",
            ),
        )
        for diagnosis, count in zip(diagnoses, movements.tolist(), strict=True)
    ]
