"""From what stands on the command line to runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from failuretwin.data_knowledge.reading import ReadOptions, read_runs
from failuretwin.data_knowledge.session_runs import As
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr


def read_inputs(
    sources: Sequence[Path], robot: Robot, how: str, published_labels: bool
) -> xr.Dataset:
    """Return the runs of all inputs as one run set."""
    return read_runs(list(sources), robot, ReadOptions(cast(As, how), published_labels))
