"""One run set from parts that come one after the other, in any order."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.errors import InputError

if TYPE_CHECKING:
    import xarray as xr


def assemble(parts: Iterable[tuple[int, xr.Dataset]], runs: int) -> xr.Dataset:
    """Return one run set in which every part has its place; no run is held twice.

    Args:
        parts: Number of the first run of each part, and the part; all of one kind and length.
        runs: Number of runs in all; together the parts hold each of them once.

    Raises:
        InputError: If there are no parts.
    """
    arrays: dict[str, np.ndarray] = {}
    last = None
    for first, last in parts:
        for name, variable in last.variables.items():
            if variable.dims[:1] != ("run",):
                continue
            shape = (runs, *variable.shape[1:])
            whole = arrays.setdefault(str(name), np.empty(shape, variable.dtype))
            whole[first : first + variable.shape[0]] = variable.values
    if last is None:
        raise InputError("there are no runs to put together. Expected one run set at least.")
    shared = last.drop_dims("run")
    changed = {name: (last[name].dims, array, last[name].attrs) for name, array in arrays.items()}
    coordinates = {"run": changed.pop("run")}
    whole_set = shared.assign_coords(coordinates).assign(changed)
    return whole_set[list(last.data_vars)]
