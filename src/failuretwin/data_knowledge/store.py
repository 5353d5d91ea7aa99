"""Run sets on disk: NetCDF (`.nc`) and Zarr (`.zarr`), written whole or not at all."""

from __future__ import annotations

import os
import shutil
import socket
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.runs import check_runs

if TYPE_CHECKING:
    import xarray as xr
    from zarr.core.buffer import Buffer

SUFFIXES = (".nc", ".zarr")


def load_run_set(path: Path) -> xr.Dataset:
    """Read a stored run set into memory.

    Raises:
        InputError: If the file cannot be read or is not a run set.
    """
    opener = _open_netcdf if path.suffix == ".nc" else _open_zarr
    try:
        with opener(path) as stored:
            runs = stored.load()
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            f"{path}: cannot be read as a run set ({reason(error)}). Expected NetCDF (.nc) or "
            "Zarr (.zarr) as `failuretwin simulate` and `failuretwin import` write them."
        ) from error
    return check_runs(runs, str(path))


def _open_netcdf(path: Path) -> xr.Dataset:
    import xarray as xr

    return xr.open_dataset(path, engine="h5netcdf")


def _open_zarr(path: Path) -> xr.Dataset:
    import xarray as xr

    return xr.open_zarr(path, chunks=None)  # read at once, so nothing is gained by Dask's arrays


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
            write_files(_zarr_files(runs), partial)


def _zarr_files(runs: xr.Dataset) -> dict[str, Buffer]:
    from zarr.storage import MemoryStore

    content: dict[str, Buffer] = {}
    with quiet_zarr():
        runs.to_zarr(MemoryStore(content), mode="w", consolidated=True)
    return content


def write_files(content: Mapping[str, Buffer], folder: Path) -> None:
    """Write the files of a Zarr store in memory to a folder.

    Raises:
        OSError: If one of them cannot be written.
    """
    for key, value in content.items():
        file = folder / key
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(value.to_bytes())


@contextmanager
def quiet_zarr() -> Iterator[None]:
    """Keep to ourselves that text and consolidated metadata are not in Zarr's final text yet."""
    with warnings.catch_warnings():
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
        OutputError: If writing fails for whatever reason of the disk; the unfinished work is
            removed and `path` is as before.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        yield path  # a pipe or a device: nothing there can be replaced
        return
    target = path.resolve()  # a link stays a link
    partial = target.with_name(f".{path.name}.{os.getpid()}.partial{path.suffix}")
    try:
        check_writable(path)
        yield partial
        atomic_replace(partial, target)
    except (OSError, RuntimeError) as error:
        raise _output_error(path, error) from error
    finally:
        with suppress(OSError):
            shutil.rmtree(partial) if partial.is_dir() else partial.unlink(missing_ok=True)


@contextmanager
def filling(folder: Path) -> Iterator[Path]:
    """Give a folder to write files to; they appear in `folder` together or not at all.

    Raises:
        OutputError: If writing fails; `folder` is as before.
    """
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    made = [parent for parent in folder.parents if not parent.exists()]
    try:
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder}: is a file. Give the name of a folder.")
        partial.mkdir(parents=True)
        yield partial
        if folder.exists():
            for file in partial.iterdir():
                file.replace(folder / file.name)
        else:
            partial.replace(folder)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        for parent in made:
            with suppress(OSError):
                parent.rmdir()
        raise _output_error(folder, error) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _output_error(path: Path, error: BaseException) -> OutputError:
    if isinstance(error, OutputError):
        return error
    return OutputError(
        f"{path}: could not be written ({reason(error)}). Nothing was left behind; free some "
        "space or choose another place."
    )


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


def reason(error: BaseException) -> str:
    """Return what the system or a library says of an error, on one line."""
    text = getattr(error, "strerror", None) or str(error)
    return one_line(text) or type(error).__name__


def one_line(text: str) -> str:
    """Return the text of another library's error on one line, without its inner details."""
    return " ".join(text.partition("(")[0].split())


# One writer at a time: a lock that ends with the process that holds it.


@contextmanager
def sole_writer(path: Path) -> Iterator[None]:
    """Hold the lock `.NAME.lock` beside `path`; nobody else can write `path` meanwhile.

    The system lets go of the lock when its process dies, however that happens, so the file of a
    dead process holds nobody back.

    Raises:
        OutputError: If another process holds it, or if it cannot be made.
    """
    from filelock import FileLock, Timeout

    file = path.with_name(f".{path.name}.lock")
    lock = FileLock(file, timeout=0)
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
            file.write_text(f"process {os.getpid()} on {socket.gethostname()}")
        yield
    finally:
        file.unlink(missing_ok=True)  # before letting go: nobody can lock a file that has no name
        lock.release()


def _holder(lock: Path) -> str:
    """Return who wrote a lock file."""
    with suppress(OSError):
        return lock.read_text(errors="replace") or "another process"
    return "another process"
