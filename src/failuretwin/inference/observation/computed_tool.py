"""Tool paths that were computed from the motors' own readings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.types import as_floats
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr

SAME_PLACE_M = 1e-6
"""Rounding error of a tool path that is computed from motor readings [m]."""


def is_computed(runs: xr.Dataset, twin: DigitalTwin) -> bool:
    """Return whether the tool of some logs is computed from the motors' own readings."""
    if "position" not in runs or str(runs.attrs.get("source", "")).startswith("simulated"):
        return False
    position, measured = (as_floats(runs[name].values) for name in ("position", "measured"))
    both = np.isfinite(position).all(axis=-1) & np.isfinite(measured).all(axis=-1)
    off = np.abs(twin.path(position[both]) - measured[both])
    return bool(both.any() and np.median(off.max(axis=-1)) < SAME_PLACE_M)
