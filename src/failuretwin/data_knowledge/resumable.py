"""Run sets of any size: made piece by piece, straight to Zarr, by one process or many.

Whoever makes a piece writes it, so memory does not grow with the number of runs. Pieces, and with
them all bytes, are the same for any number of workers. Work that was cut short is continued.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shutil
import socket
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin import __version__
from failuretwin.core.config import fingerprint
from failuretwin.core.errors import FailureTwinError, InputError, OutputError
from failuretwin.data_knowledge.generate import CHUNK_RUNS, Plan, simulate, simulate_runs
from failuretwin.data_knowledge.store import (
    check_destination,
    reason,
    save_run_set,
    sole_writer,
    take_place,
)
from failuretwin.data_knowledge.workers import ONE_PROCESS, Workforce

if TYPE_CHECKING:
    import xarray as xr
    from zarr.core.buffer import Buffer

# The Zarr layout of a run set that is written in pieces, each by whoever made it.

RUN = "run"
COMPRESSION_LEVEL = 5


@dataclass(frozen=True)
class Layout:
    """Everything of a Zarr run set but its runs.

    Attributes:
        root: The group's metadata, which make the store readable: the last file to write.
        shared: All other files that do not depend on the runs, by name.
        per_run: File of each variable's first piece, by the variable's name.
    """

    root: bytes
    shared: Mapping[str, bytes]
    per_run: Mapping[str, str]

    def piece_files(self, piece: int) -> list[str]:
        """Return the names of the files that a piece may have; what is all missing has none."""
        return [name.replace("/c.0", f"/c.{piece}", 1) for name in self.per_run.values()]


def layout_of(example: xr.Dataset, runs: int, piece_runs: int) -> Layout:
    """Return the layout of a run set.

    Args:
        example: A run set of the same kind, with any number of runs.
        runs: Number of runs in all.
        piece_runs: Runs in a piece.
    """
    from zarr.codecs import BloscCodec
    from zarr.storage import MemoryStore

    varying = [str(name) for name, v in example.variables.items() if v.dims[:1] == (RUN,)]
    numbers = [name for name in varying if example[name].dtype.kind == "f"]
    codec = BloscCodec(cname="lz4", clevel=COMPRESSION_LEVEL, shuffle="shuffle", typesize=8)
    content: dict[str, Buffer] = {}
    with _quiet():
        example.to_zarr(
            MemoryStore(content),
            mode="w",
            consolidated=True,
            encoding={name: {"compressors": (codec,)} for name in numbers},
        )
    files = {key: value.to_bytes() for key, value in content.items()}
    root = json.loads(files.pop("zarr.json"))
    shared = {}
    for key, value in files.items():
        name, _, rest = key.partition("/")
        if name not in varying:
            shared[key] = value
        elif rest == "zarr.json":
            whole = _resized(json.loads(value), runs, piece_runs)
            root["consolidated_metadata"]["metadata"][name] |= whole
            shared[key] = _to_json(whole)
    per_run = {name: f"{name}/c.0" + ".0" * (example[name].ndim - 1) for name in varying}
    return Layout(_to_json(root), shared, per_run)


def _resized(array: dict[str, Any], runs: int, piece_runs: int) -> dict[str, Any]:
    """Return an array's metadata with the number of runs in all and in a piece."""
    grid = {"chunk_shape": [piece_runs, *array["shape"][1:]]}
    return {
        **array,
        "shape": [runs, *array["shape"][1:]],
        "chunk_grid": {"name": "regular", "configuration": grid},
        # Dots, not folders: every variable is one flat folder, made before the first piece.
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},
    }


def _to_json(value: Mapping[str, Any]) -> bytes:
    return json.dumps(value, indent=2).encode()


def piece_content(layout: Layout, part: xr.Dataset, first: int) -> dict[str, bytes]:
    """Return the files of one piece by name; what is all missing has no file.

    Args:
        layout: Layout of the whole run set.
        part: The runs of the piece.
        first: Number of its first run.

    Raises:
        ValueError: If the runs do not fit the layout.
    """
    import zarr
    from zarr.core.buffer import default_buffer_prototype
    from zarr.storage import MemoryStore

    new_buffer = default_buffer_prototype().buffer.from_bytes
    metadata = {f"{name}/zarr.json" for name in layout.per_run}
    content = {key: new_buffer(layout.shared[key]) for key in metadata}
    store = MemoryStore(content)
    with _quiet(), _one_thread():
        for name in layout.per_run:
            array = zarr.open_array(store, path=name, mode="r+")
            values = part[name].values
            if values.shape[1:] != array.shape[1:]:
                raise ValueError(f"{name} is {values.shape} in a run set of {array.shape}")
            array[first : first + len(values)] = values
    return {key: value.to_bytes() for key, value in content.items() if key not in metadata}


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep to ourselves that text and consolidated metadata are not in Zarr's final text yet."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Zarr (V3|format 3).*")
        yield


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compress in one thread: several may store blocks in any order, so bytes would differ."""
    from numcodecs import blosc

    before = blosc.use_threads
    blosc.use_threads = False
    try:
        yield
    finally:
        blosc.use_threads = before


# A Zarr run set in the making: a hidden folder beside its destination, fit to be continued.

MANIFEST = "manifest.json"
GROUP = "zarr.json"


@dataclass(frozen=True)
class Unfinished:
    """A run set in the making.

    Attributes:
        folder: The hidden folder.
        layout: What is written beside the runs.
    """

    folder: Path
    layout: Layout

    @property
    def store(self) -> Path:
        """What will be the run set."""
        return self.folder / "store"

    def add(self, piece: int, content: Mapping[str, bytes]) -> str:
        """Write a piece and mark it as done; return its hash.

        Every file appears whole, so it does no harm if two processes make the same piece.

        Raises:
            OSError: If a file cannot be written, or the folder is not there.
        """
        for name, data in content.items():
            self.put(self.store / name, data)
        digest = _digest(content)
        self.put(self._mark(piece), digest.encode())
        return digest

    def marked(self) -> list[int]:
        """Return the pieces that are marked as done, in their order."""
        return sorted(int(mark.name) for mark in (self.folder / "done").glob("*"))

    def finished(self) -> dict[int, str]:
        """Return the hash of every finished piece; a mark that does not fit is removed."""
        found = {}
        for piece in self.marked():
            files = {name: self.store / name for name in self.layout.piece_files(piece)}
            digest = _digest({n: f.read_bytes() for n, f in files.items() if f.is_file()})
            if self._mark(piece).read_text() == digest:
                found[piece] = digest
            else:
                self._mark(piece).unlink()
        return found

    def finish(self, manifest: Mapping[str, Any], path: Path) -> None:
        """Make the store readable and put it where `path` is.

        Raises:
            OSError: If that cannot be done; `path` is as before.
        """
        self.put(self.store / MANIFEST, _sorted_json(manifest))
        self.put(self.store / GROUP, self.layout.root)
        take_place(self.store, path)
        self.remove()

    def remove(self) -> None:
        """Remove all of it."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _mark(self, piece: int) -> Path:
        return self.folder / "done" / str(piece)

    def put(self, file: Path, data: bytes) -> None:
        """Write a file that appears whole or not at all.

        Raises:
            OSError: If it cannot be written.
        """
        maker = f"{socket.gethostname()}-{os.getpid()}-{threading.get_ident()}"
        new = self.folder / "making" / maker
        try:
            new.write_bytes(data)
            new.replace(file)
        except OSError:
            new.unlink(missing_ok=True)
            raise


def take_up(path: Path, layout: Layout, manifest: Mapping[str, Any]) -> Unfinished:
    """Return the run set in the making for `path`: what an earlier process left, or a new one.

    What is left of anything else that was to go to `path` is removed.

    Args:
        path: Where the run set will be, an absolute path.
        layout: Its layout.
        manifest: What is being made; work that says anything else is not continued.

    Raises:
        OSError: If a folder cannot be made.
    """
    name = f".{path.name}.{fingerprint(manifest)[:16]}.partial"
    pattern = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{16}}\.partial")
    for other in path.parent.iterdir():
        if pattern.fullmatch(other.name) and other.name != name:
            shutil.rmtree(other)
    unfinished = Unfinished(path.with_name(name), layout)
    if not _can_go_on(unfinished, manifest):
        _begin(unfinished, manifest)
    return unfinished


def _can_go_on(unfinished: Unfinished, manifest: Mapping[str, Any]) -> bool:
    if not _says(unfinished.folder, manifest):
        return False
    # A store that can be read has been finished; it may be an old one that has just been replaced.
    return not (unfinished.store / GROUP).exists() or _says(unfinished.store, manifest)


def _says(folder: Path, manifest: Mapping[str, Any]) -> bool:
    """Return whether the manifest in a folder says all that `manifest` says."""
    try:
        told = json.loads((folder / MANIFEST).read_bytes())
    except (OSError, ValueError):
        return False
    known = {key: told[key] for key in manifest if key in told}
    return fingerprint(known) == fingerprint(manifest)


def _begin(unfinished: Unfinished, manifest: Mapping[str, Any]) -> None:
    """Write all that does not depend on runs; the manifest comes last."""
    unfinished.remove()
    shared = {unfinished.store / name: data for name, data in unfinished.layout.shared.items()}
    try:
        for name in ("done", "making", "store"):
            (unfinished.folder / name).mkdir(parents=True)
        for file, data in shared.items():
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(data)
        unfinished.put(unfinished.folder / MANIFEST, _sorted_json(manifest))
    except OSError:
        unfinished.remove()
        raise


def whole_digest(pieces: Sequence[str]) -> str:
    """Return the hash of a run set: SHA-256 over the hashes of its pieces in their order."""
    return hashlib.sha256("".join(pieces).encode()).hexdigest()


def _digest(content: Mapping[str, bytes]) -> str:
    """Return the hash of a piece: SHA-256 over name, NUL, size, NUL, bytes of its files by name."""
    total = hashlib.sha256()
    for name in sorted(content):
        total.update(f"{name}\0{len(content[name])}\0".encode())
        total.update(content[name])
    return total.hexdigest()


def _sorted_json(value: Mapping[str, Any]) -> bytes:
    return (json.dumps(value, indent=2, sort_keys=True) + "\n").encode()


# One piece of a run set that many processes make: what it needs, and how it is made.

DECISIVE = ("numpy", "scipy", "zarr", "numcodecs")
"""Packages, beside ourselves, whose versions may change bytes of a run set."""


def versions() -> dict[str, str]:
    """Return the versions that every process must share for bytes to be the same."""
    others = {name: import_module(name).__version__ for name in DECISIVE}
    return {"failuretwin": __version__, **others}


@dataclass(frozen=True)
class Job:
    """What a worker must know to make any piece.

    Attributes:
        plan: What to simulate.
        unfinished: Where it goes.
        piece_runs: Runs in a piece.
        versions: Versions that the worker must have.
    """

    plan: Plan
    unfinished: Unfinished
    piece_runs: int
    versions: dict[str, str]

    @property
    def pieces(self) -> int:
        """Number of pieces."""
        return -(-self.plan.size // self.piece_runs)

    def runs_of(self, piece: int) -> range:
        """Return the numbers of the runs in a piece."""
        first = piece * self.piece_runs
        return range(first, min(first + self.piece_runs, self.plan.size))


def make_piece(job: Job, piece: int) -> str:
    """Make a piece and write it; return the hash of its files.

    Raises:
        InputError: If this process has other versions than the one that gave the job, or cannot
            see where the run set is made.
        OSError: If the piece cannot be written.
    """
    if versions() != job.versions:
        raise InputError(
            f"worker on {platform.node()} has {_listed(versions())}, expected "
            f"{_listed(job.versions)}. Install the same versions there."
        )
    if not job.unfinished.folder.is_dir():
        raise InputError(
            f"worker on {platform.node()} sees no {job.unfinished.folder}. Write to a folder that "
            "all workers share under the same path."
        )
    runs = job.runs_of(piece)
    part = simulate_runs(job.plan, runs).to_dataset()
    return job.unfinished.add(piece, piece_content(job.unfinished.layout, part, runs[0]))


def _listed(found: dict[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in found.items())


LARGEST_NETCDF_BYTES = 600_000_000
"""Largest run set written as NetCDF; memory needed is about twice that."""


def produce(
    plan: Plan,
    path: Path,
    workforce: Workforce = ONE_PROCESS,
    on_progress: Callable[[int], None] = lambda runs: None,
    tell: Callable[[str], None] = lambda text: None,
    piece_runs: int = CHUNK_RUNS,
) -> None:
    """Simulate all runs of a plan into a run set; continue where such work was cut short.

    Until all is there, `path` is as before, and pieces that are done lie in a hidden folder
    beside it, from which the same call goes on. Memory does not depend on the number of runs.
    NetCDF (.nc) is made in memory, for sets of moderate size, and cannot be continued.

    Args:
        plan: What to simulate.
        path: The run set to write (.zarr or .nc); one of that name is replaced at the end.
        workforce: Who does the work; the run set does not depend on it.
        on_progress: Called with the number of runs that are there on top of those before.
        tell: Called with one line about runs of an earlier attempt, or of this one if it fails.
        piece_runs: Runs in a piece, that is in a Zarr chunk.

    Raises:
        InputError: If the workforce cannot be had or cannot do the work, or the runs are too many
            for NetCDF.
        OutputError: If it cannot be written, or another process is writing it.
    """
    check_destination(path)
    if path.suffix == ".nc":
        _check_fits_memory(plan, path)
        runs = simulate(plan, workforce.workers, on_progress, workforce.scheduler)
        save_run_set(runs, path)
        return
    target = path.resolve()  # a link stays a link
    with sole_writer(target):
        job, manifest = _open_job(plan, path, piece_runs)
        try:
            done = _make_all(job, workforce, on_progress, tell)
            content = whole_digest([done[piece] for piece in range(job.pieces)])
            job.unfinished.finish({**manifest, "content": content}, target)
        except BaseException as error:
            _leave(job, tell)
            if isinstance(error, OSError) and not isinstance(error, FailureTwinError):
                raise _output_error(path, error) from error
            raise


def _check_fits_memory(plan: Plan, path: Path) -> None:
    each = simulate_runs(plan, [0]).to_dataset().nbytes
    if plan.size * each > LARGEST_NETCDF_BYTES:
        raise InputError(
            f"{path}: {plan.size} runs are {plan.size * each / 1e6:.0f} MB, and NetCDF is made in "
            f"memory, up to {LARGEST_NETCDF_BYTES / 1e6:.0f} MB. Write to "
            f"{path.with_suffix('.zarr').name}, which has no such limit."
        )


def _open_job(plan: Plan, path: Path, piece_runs: int) -> tuple[Job, dict[str, Any]]:
    """Return the job and the manifest of what it makes."""
    layout = layout_of(simulate_runs(plan, [0]).to_dataset(), plan.size, piece_runs)
    manifest = {
        **plan.manifest(),
        "runs": plan.size,
        "runs_per_chunk": piece_runs,
        "versions": {**versions(), "python": platform.python_version()},
    }
    try:
        unfinished = take_up(path.resolve(), layout, manifest)
    except OSError as error:
        raise _output_error(path, error) from error
    return Job(plan, unfinished, piece_runs, versions()), manifest


def _make_all(
    job: Job,
    workforce: Workforce,
    on_progress: Callable[[int], None],
    tell: Callable[[str], None],
) -> dict[int, str]:
    """Make every piece that is missing; return the hashes of all."""
    done = job.unfinished.finished()
    there = _count_runs(job, done)
    if there:
        tell(f"continuing: {there} of {job.plan.size} runs were there")
        on_progress(there)
    missing = [piece for piece in range(job.pieces) if piece not in done]
    if missing:
        with workforce.at_work(partial(make_piece, job), missing) as results:
            for piece, digest in results:
                done[piece] = digest
                on_progress(len(job.runs_of(piece)))
    return done


def _count_runs(job: Job, pieces: Iterable[int]) -> int:
    return sum(len(job.runs_of(piece)) for piece in pieces)


def _leave(job: Job, tell: Callable[[str], None]) -> None:
    """Keep the pieces that are done, if there are any, and say so."""
    kept = _count_runs(job, job.unfinished.marked())
    if kept:
        tell(
            f"{kept} of {job.plan.size} runs are kept in {job.unfinished.folder}; the same command "
            "goes on from there"
        )
    else:
        job.unfinished.remove()


def _output_error(path: Path, error: OSError) -> OutputError:
    return OutputError(
        f"{path}: could not be written ({reason(error)}). Free some space or choose another place."
    )
