"""Run sets on disk: NetCDF (`.nc`) and Zarr (`.zarr`), written whole or not at all."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.runs import check_runs

if TYPE_CHECKING:
    import xarray as xr

SUFFIXES = (".nc", ".zarr")


def load_run_set(path: Path) -> xr.Dataset:
    """Read a stored run set into memory.

    Raises:
        InputError: If the file cannot be read or is not a run set.
    """
    import xarray as xr

    opener = _open_netcdf if path.suffix == ".nc" else xr.open_zarr
    try:
        with opener(path) as stored:
            runs = stored.load()
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(
            f"{path}: cannot be read as a run set ({reason[0]}). Expected NetCDF (.nc) or Zarr "
            "(.zarr) as `failuretwin simulate` and `failuretwin import` write them."
        ) from error
    return check_runs(runs, str(path))


def _open_netcdf(path: Path) -> xr.Dataset:
    import xarray as xr

    return xr.open_dataset(path, engine="h5netcdf")


def save_run_set(runs: xr.Dataset, path: Path) -> None:
    """Write a run set; a file of that name is replaced at the end, all at once.

    Raises:
        InputError: If the suffix is neither .nc nor .zarr.
        OutputError: If it cannot be written; nothing is left behind.
    """
    check_suffix(path)
    with replacing(path) as partial, warnings.catch_warnings():
        # Zarr warns that text and consolidated metadata are not in its final specification yet.
        warnings.filterwarnings("ignore", message=".*Zarr (V3|format 3).*")
        if path.suffix == ".nc":
            runs.to_netcdf(partial, engine="h5netcdf", encoding=_compression(runs))
        else:
            runs.to_zarr(partial, mode="w", consolidated=True)


def check_suffix(path: Path) -> None:
    """Raise InputError unless `path` ends in .nc or .zarr."""
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: a run set ends in .nc (NetCDF) or .zarr (Zarr).")


def _compression(runs: xr.Dataset) -> dict[str, dict[str, object]]:
    large = [n for n in runs.data_vars if "time" in runs[n].dims]
    return {str(name): {"zlib": True, "complevel": 1, "shuffle": True} for name in large}


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a path to write to; what stands there in the end takes the place of `path`.

    Raises:
        OutputError: If writing fails for whatever reason of the disk; the unfinished work is
            removed and `path` is as before.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial{path.suffix}")
    try:
        _check_writable(path)
        yield partial
        if path.is_dir():
            shutil.rmtree(path)
        partial.replace(path)
    except (OSError, RuntimeError) as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(
            f"{path}: could not be written ({_reason(error)}). Nothing was left behind; free some "
            "space or choose another place."
        ) from error
    finally:
        with suppress(OSError):
            shutil.rmtree(partial) if partial.is_dir() else partial.unlink(missing_ok=True)


def _check_writable(path: Path) -> None:
    folder = path.parent
    if not folder.is_dir():
        raise OutputError(f"{path}: folder {folder} does not exist. Make it first.")
    if not os.access(folder, os.W_OK):
        raise OutputError(f"{path}: folder {folder} is not writable. Choose another.")
    if path.is_dir() and path.suffix != ".zarr":
        raise OutputError(f"{path}: is a folder. Give the name of a file.")


def _reason(error: BaseException) -> str:
    text = getattr(error, "strerror", None) or str(error)
    return text.strip().splitlines()[0] if text.strip() else type(error).__name__
