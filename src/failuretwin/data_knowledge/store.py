"""Run sets on disk: NetCDF (`.nc`) and Zarr (`.zarr`), written whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
import socket
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin.core.errors import InputError, OutputError, reason
from failuretwin.core.foreign import reading
from failuretwin.core.runs import check_duration, check_layout, check_runs, time_step
from failuretwin.data_knowledge.readers.file_claims import check_netcdf, check_zarr

if TYPE_CHECKING:
    import xarray as xr
    from zarr.core.buffer import Buffer

SUFFIXES = (".nc", ".zarr")
EXPECTED = (
    "Expected NetCDF (.nc) or Zarr (.zarr) as `failuretwin simulate` and `failuretwin import` "
    "write them."
)


def load_run_set(path: Path) -> xr.Dataset:
    """Read a stored run set into memory, once what it claims to be has been checked.

    Raises:
        InputError: If the file cannot be read, is not a run set, claims more than it can mean, or
            has a codec that this package does not write.
    """
    with reading(path, "a run set", EXPECTED), _checked(path, None) as stored:
        runs = check_runs(stored.load(), str(path))
        # A step more is accepted: thinning of the grid may have kept the length.
        check_duration(runs, str(path), float(runs["time"].values[-1]) + time_step(runs))
        return runs


def open_run_set(path: Path, most_runs: int) -> xr.Dataset:
    """Open a stored run set of any size; values are read when they are asked for.

    What the file claims of so many runs in memory at a time is checked; the values are not.

    Raises:
        InputError: If the file cannot be read, is not a run set, claims more than it can mean, or
            has a codec that this package does not write.
    """
    with reading(path, "a run set", EXPECTED):
        opened = _checked(path, most_runs)
        check_layout(opened, str(path))
        return opened


def _checked(path: Path, most_runs: int | None) -> xr.Dataset:
    """Open a run set once what it claims of `most_runs` in memory (None: all) has been checked.

    A Zarr store is opened by the very metadata that were checked, not by the copy in its root,
    and without Dask's arrays, by which nothing would be gained.
    """
    import xarray as xr

    if path.suffix == ".nc":
        check_netcdf(path, most_runs)
        return xr.open_dataset(path, engine="h5netcdf", decode_times=False)
    check_zarr(path, most_runs)
    with warnings.catch_warnings():  # our manifest lies beside the arrays
        warnings.filterwarnings("ignore", message="Object at .* is not recognized")
        return xr.open_zarr(path, chunks=None, consolidated=False, decode_times=False)


def save_run_set(runs: xr.Dataset, path: Path) -> None:
    """Write a run set; a file of that name is replaced at the end, all at once.

    Raises:
        InputError: If the suffix is neither .nc nor .zarr.
        OutputError: If it cannot be written; nothing is left behind.
    """
    check_destination(path)
    with replacing(path) as partial:
        # In memory first: on a full disk the HDF5 library can bring the whole process down, and
        # Zarr's own writes go on after one of them has failed.
        if path.suffix == ".nc":
            partial.write_bytes(runs.to_netcdf(engine="h5netcdf", encoding=_compression(runs)))
        else:
            _write_zarr(runs, partial)


def _write_zarr(runs: xr.Dataset, folder: Path) -> None:
    from zarr.storage import MemoryStore

    content: dict[str, Buffer] = {}
    with writing_zarr():
        runs.to_zarr(MemoryStore(content), mode="w", consolidated=True)
    for key, value in content.items():
        file = folder / key
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(value.to_bytes())


@contextmanager
def writing_zarr() -> Iterator[None]:
    """Write every chunk, so that one without a file is one that was lost.

    Warnings that text and consolidated metadata are not in Zarr's final standard are left out.
    """
    import zarr

    with warnings.catch_warnings(), zarr.config.set({"array.write_empty_chunks": True}):
        warnings.filterwarnings("ignore", message=".*Zarr (V3|format 3).*")
        yield


def check_destination(path: Path) -> None:
    """Raise an error unless a run set can be written to `path`: worth asking before long work."""
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: a run set ends in .nc (NetCDF) or .zarr (Zarr).")
    check_writable(path)


def _compression(runs: xr.Dataset) -> dict[str, dict[str, object]]:
    large = [n for n in runs.data_vars if "time" in runs[n].dims]
    return {str(name): {"zlib": True, "complevel": 1, "shuffle": True} for name in large}


# Something new where something old stands: beside it first, then renamed.


def atomic_replace(new: Path, path: Path) -> None:
    """Put `new` where `path` is; a folder there is kept as `.NAME.old` until the new one stands.

    Raises:
        OSError: If that cannot be done; `path` is as before.
    """
    old = path.with_name(f".{path.name}.old")
    if path.is_dir():  # no system call of Python replaces a folder that holds something
        shutil.rmtree(old, ignore_errors=True)
        path.replace(old)
    try:
        new.replace(path)
    except BaseException:
        if old.is_dir():
            old.replace(path)
        raise
    shutil.rmtree(old, ignore_errors=True)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a path to write to; what stands there in the end takes the place of `path`.

    Raises:
        OutputError: If writing fails for whatever reason of the disk, or another process writes
            `path` all the while; the unfinished work is removed and `path` is as before.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        yield path  # a pipe or a device: nothing there can be replaced
        return
    check_writable(path)
    target = path.resolve()  # a link stays a link
    with _beside(target, path) as partial:
        yield partial
        atomic_replace(partial, target)


def write_text(text: str, path: Path) -> None:
    """Write a text file (UTF-8), atomically.

    Raises:
        OutputError: If it cannot be written; `path` is as before.
    """
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_records(records: Iterable[Mapping[str, Any]], path: Path) -> None:
    """Write JSON objects, one a line, atomically.

    Raises:
        OutputError: If they cannot be written; `path` is as before.
    """
    write_text("".join(json.dumps(record) + "\n" for record in records), path)


@contextmanager
def filling(folder: Path) -> Iterator[Path]:
    """Give a folder to write files to; they appear in `folder` together or not at all.

    Raises:
        OutputError: If writing fails, or another process fills `folder` all the while; `folder` is
            as before.
    """
    check_fillable(folder)
    made = [parent for parent in folder.parents if not parent.exists()]
    try:
        with _beside(folder, folder) as partial:
            partial.mkdir()
            yield partial
            if folder.exists():
                for file in partial.iterdir():
                    file.replace(folder / file.name)
            else:
                partial.replace(folder)
    except OutputError:
        for parent in made:
            with suppress(OSError):
                parent.rmdir()
        raise


@contextmanager
def _beside(target: Path, path: Path) -> Iterator[Path]:
    """Give a hidden path beside `target` to its sole writer; nothing is left there in the end.

    Raises:
        OutputError: If the disk fails; the text names `path`.
    """
    partial = target.with_name(f".{target.name}.partial{path.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with sole_writer(target, PATIENCE_S):
            _remove(partial)  # of a process that died
            try:
                yield partial
            finally:
                _remove(partial)
    except OutputError:
        raise
    except (OSError, RuntimeError) as error:
        raise OutputError(
            f"{path}: could not be written ({reason(error)}). Nothing was left behind; free some "
            "space or choose another place."
        ) from error


def _remove(path: Path) -> None:
    with suppress(OSError):
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """Raise OutputError unless a file can be written to `path`."""
    folder = path.parent
    if not folder.is_dir():
        raise OutputError(f"{path}: folder {folder} does not exist. Make it first.")
    if not os.access(folder, os.W_OK):
        raise OutputError(f"{path}: folder {folder} is not writable. Choose another.")
    if path.is_dir() and path.suffix != ".zarr":
        raise OutputError(f"{path}: is a folder. Give the name of a file.")
    if path.is_dir() and not (path / "zarr.json").is_file() and any(path.iterdir()):
        raise OutputError(
            f"{path}: is a folder that holds something else than a Zarr store. It is left alone; "
            "choose another name."
        )
    if path.is_file() and path.suffix == ".zarr":
        raise OutputError(f"{path}: is a file, and a Zarr store is a folder. Choose another name.")


def check_fillable(folder: Path) -> None:
    """Raise OutputError unless files can be written to a folder, which need not exist yet."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file. Give the name of a folder.")
    above = next(parent for parent in [folder, *folder.absolute().parents] if parent.exists())
    if not (above.is_dir() and os.access(above, os.W_OK)):
        raise OutputError(f"{folder}: cannot be made in {above}. Choose another.")


# One writer at a time: a lock that ends with the process that holds it.


PATIENCE_S = 10.0
"""Time that the writer of a file or folder waits for another one [s]."""


@contextmanager
def sole_writer(path: Path, patience_s: float = 0.0) -> Iterator[None]:
    """Hold the lock `.NAME.lock` beside `path`; nobody else can write `path` meanwhile.

    The system lets go of the lock when its process dies, however that happens, so the file of a
    dead process holds nobody back. `patience_s` is how long another writer is waited for [s].

    Raises:
        OutputError: If another process holds it, or if it cannot be made.
    """
    from filelock import FileLock, Timeout

    file = path.with_name(f".{path.name}.lock")
    lock = FileLock(file, timeout=patience_s)
    try:
        lock.acquire()
    except Timeout as error:
        raise OutputError(
            f"{path}: {_holder(file)} is writing it. Wait until it is done, or choose another name."
        ) from error
    except OSError as error:
        raise OutputError(f"{path}: lock {file} cannot be made ({error.strerror}).") from error
    try:
        with suppress(OSError):  # on a full disk it goes without a name
            file.write_bytes(f"process {os.getpid()} on {socket.gethostname()}".encode())
        yield
    finally:
        with suppress(OSError):  # before letting go: nobody can lock a file that has no name
            file.unlink()
        lock.release()


def _holder(lock: Path) -> str:
    """Return who wrote a lock file."""
    with suppress(OSError):
        return lock.read_text(errors="replace") or "another process"
    return "another process"
