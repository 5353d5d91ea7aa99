"""Run sets of any size, made chunk by chunk in a Zarr store by one process or many.

The process that makes a chunk writes it, so memory does not grow with the number of runs. All bytes
are the same for any number of workers. Interrupted work is continued.
"""

from __future__ import annotations

import glob
import hashlib
import json
import platform
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin import __version__
from failuretwin.core.config import fingerprint
from failuretwin.core.errors import FailureTwinError, InputError, OutputError, reason
from failuretwin.core.runs import VARIABLES
from failuretwin.data_knowledge.generate import CHUNK_RUNS, Plan, simulate, simulate_runs
from failuretwin.data_knowledge.store import (
    atomic_replace,
    check_destination,
    save_run_set,
    sole_writer,
    writing_zarr,
)
from failuretwin.data_knowledge.workers import ONE_PROCESS, Workforce

if TYPE_CHECKING:
    import xarray as xr

MANIFEST = "manifest.json"
GROUP = "zarr.json"
"""File that makes a folder a Zarr group; it comes last, so that unfinished work is unreadable."""
COMPRESSION_LEVEL = 5
DECISIVE = ("numpy", "scipy", "zarr", "numcodecs")
"""Packages, in addition to ourselves, whose versions may change bytes of a run set."""
KEY_ENDS = {"run": "", **{name: ".0" * (len(dims) - 1) for name, (dims, _) in VARIABLES.items()}}
"""Ends of the file names of a chunk, by the variables that differ from run to run."""
LARGEST_NETCDF_BYTES = 600_000_000
"""Largest run set written as NetCDF; memory needed is about twice that."""


def produce(
    plan: Plan,
    path: Path,
    workforce: Workforce = ONE_PROCESS,
    on_progress: Callable[[int], None] = lambda runs: None,
    tell: Callable[[str], None] = lambda text: None,
    chunk_runs: int = CHUNK_RUNS,
) -> None:
    """Simulate all runs of a plan into a run set; continue interrupted work.

    Until the run set is complete, `path` is as before and finished chunks lie in a hidden folder
    beside it, from which the same call continues. Memory does not depend on the number of runs.
    NetCDF (.nc) is made in memory, for sets of moderate size, and cannot be continued.

    Args:
        plan: Robot, faults, imperfections and seed of the runs.
        path: The run set to write (.zarr or .nc); one of that name is replaced at the end.
        workforce: Processes that do the work; the run set does not depend on them.
        on_progress: Called with the number of further runs that are finished.
        tell: Called with one line about runs of an earlier attempt, or of this one if it fails.
        chunk_runs: Runs in a Zarr chunk, made and written at a time.

    Raises:
        InputError: If the workforce cannot be had or cannot do the work, or the runs are too many
            for NetCDF.
        OutputError: If it cannot be written, or another process is writing it.
    """
    check_destination(path)
    if path.suffix == ".nc":
        _check_fits_memory(plan, path)
        save_run_set(simulate(plan, workforce.workers, on_progress, workforce.scheduler), path)
        return
    target = path.resolve()  # a link stays a link
    try:
        with sole_writer(target), _unfinished(plan, target, chunk_runs, tell) as unfinished:
            content = _make_missing(unfinished, workforce, on_progress, tell)
            unfinished.finish(content, target)
    except OSError as error:
        if isinstance(error, FailureTwinError):
            raise
        raise OutputError(
            f"{path}: could not be written ({reason(error)}). Free some space or choose another "
            "place."
        ) from error


def _check_fits_memory(plan: Plan, path: Path) -> None:
    size = plan.size * simulate_runs(plan, [0]).to_dataset().nbytes
    if size > LARGEST_NETCDF_BYTES:
        raise InputError(
            f"{path}: {plan.size} runs are {size / 1e6:.0f} MB, and NetCDF is made in memory, up "
            f"to {LARGEST_NETCDF_BYTES / 1e6:.0f} MB. Write to {path.with_suffix('.zarr').name}, "
            "which has no such limit."
        )


@dataclass(frozen=True)
class UnfinishedRunSet:
    """A run set in the making, with everything a worker needs to make a chunk of it.

    The folder holds the Zarr store, the file that will make it readable, and one mark per finished
    chunk, with its hash.

    Attributes:
        plan: Robot, faults, imperfections and seed of the runs.
        folder: The hidden folder, an absolute path.
        chunk_runs: Runs in a chunk.
        versions: Versions that a worker must have.
    """

    plan: Plan
    folder: Path
    chunk_runs: int
    versions: Mapping[str, str]

    @property
    def store(self) -> Path:
        """The Zarr store."""
        return self.folder / "store"

    @property
    def marks(self) -> Path:
        """Folder of the marks, files named by the number of the chunk."""
        return self.folder / "done"

    @property
    def chunks(self) -> list[range]:
        """Numbers of the runs in each chunk."""
        return self.plan.chunks(self.chunk_runs)

    def files(self, chunk: int) -> list[Path]:
        """Return the files that a chunk may have, in the order in which they are hashed."""
        return [self.store / name / f"c.{chunk}{end}" for name, end in sorted(KEY_ENDS.items())]

    def digest(self, chunk: int) -> str:
        """Return the hash of a chunk: SHA-256 over name, NUL, size, NUL, bytes of its files."""
        total = hashlib.sha256()
        for file in self.files(chunk):
            if file.is_file():  # one that was lost gives another hash
                data = file.read_bytes()
                total.update(f"{file.parent.name}/{file.name}\0{len(data)}\0".encode() + data)
        return total.hexdigest()

    def finished(self) -> dict[int, str]:
        """Return the hash of every finished chunk; a mark that does not fit is removed."""
        found = {}
        for mark in self.marks.iterdir():
            digest = self.digest(int(mark.name))
            if mark.read_text() == digest:
                found[int(mark.name)] = digest
            else:
                mark.unlink()
        return found

    def kept_runs(self) -> int:
        """Return the number of runs in chunks that are marked as finished."""
        marks = self.marks.glob("*")
        return sum(len(self.chunks[int(mark.name)]) for mark in marks if mark.stat().st_size)

    def begin(self) -> None:
        """Write everything that does not depend on the runs, unless an earlier attempt has."""
        import zarr

        if (self.folder / GROUP).is_file():
            return
        self.remove()
        self.marks.mkdir(parents=True)
        example = simulate_runs(self.plan, [0]).to_dataset()
        encoding = {
            str(name): _encoding(values, self.chunk_runs)
            for name, values in example.variables.items()
            if name in KEY_ENDS
        }
        with writing_zarr():
            example.to_zarr(self.store, mode="w", consolidated=False, encoding=encoding)
            for name in encoding:
                array = zarr.open_array(self.store / name, mode="r+")
                array.resize((self.plan.size, *array.shape[1:]))
            zarr.consolidate_metadata(str(self.store))
        for file in self.files(0):  # the run of the example
            file.unlink(missing_ok=True)
        (self.store / GROUP).rename(self.folder / GROUP)

    def finish(self, content: str, path: Path) -> None:
        """Make the store readable and put it in the place of `path`.

        Args:
            content: Hash of the runs.
            path: Where the run set belongs; on an OSError it is as before.
        """
        for torn in self.store.rglob("*.partial"):  # of a process that was killed as it wrote
            torn.unlink()
        manifest = {**_manifest(self.plan, self.chunk_runs), "content": content}
        text = json.dumps(manifest, indent=2, sort_keys=True) + "\n"
        (self.store / MANIFEST).write_bytes(text.encode())
        shutil.copyfile(self.folder / GROUP, self.store / GROUP)
        atomic_replace(self.store, path)
        self.remove()

    def remove(self) -> None:
        """Remove all of it."""
        shutil.rmtree(self.folder, ignore_errors=True)


def make_chunk(unfinished: UnfinishedRunSet, chunk: int) -> str:
    """Make a chunk and write it; return the hash of its files.

    Every file appears whole, so it does no harm if two processes make the same chunk.

    Raises:
        InputError: If this process has other versions than the one that asks, or cannot see
            where the run set is made.
        OSError: If the chunk cannot be written.
    """
    import zarr

    if versions() != unfinished.versions:
        raise InputError(
            f"worker on {platform.node()} has {_listed(versions())}, expected "
            f"{_listed(unfinished.versions)}. Install the same versions there."
        )
    if not unfinished.folder.is_dir():
        raise InputError(
            f"worker on {platform.node()} sees no {unfinished.folder}. Write to a folder that "
            "all workers share under the same path."
        )
    runs = unfinished.chunks[chunk]
    part = simulate_runs(unfinished.plan, runs).to_dataset()
    with writing_zarr():
        for name in KEY_ENDS.keys() & part.variables:
            array = zarr.open_array(unfinished.store / name, mode="r+")
            array[runs.start : runs.stop] = part[name].values
    digest = unfinished.digest(chunk)
    (unfinished.marks / str(chunk)).write_text(digest)
    return digest


@contextmanager
def _unfinished(
    plan: Plan, path: Path, chunk_runs: int, tell: Callable[[str], None]
) -> Iterator[UnfinishedRunSet]:
    """Give the unfinished run set for `path`, new or as an earlier attempt left it.

    Unfinished work of another plan for `path` is removed. If the block fails, finished chunks are
    kept.
    """
    start, end = f".{path.name}.", ".partial"
    folder = path.with_name(start + fingerprint(_manifest(plan, chunk_runs))[:16] + end)
    for other in path.parent.glob(f"{glob.escape(start)}{'[0-9a-f]' * 16}{end}"):
        if other != folder:
            shutil.rmtree(other)
    unfinished = UnfinishedRunSet(plan, folder, chunk_runs, versions())
    try:
        unfinished.begin()
        yield unfinished
    except BaseException:
        kept = unfinished.kept_runs()
        if kept:
            tell(
                f"{kept} of {plan.size} runs are kept in {folder}; the same command goes on from "
                "there"
            )
        else:
            unfinished.remove()
        raise


def _make_missing(
    unfinished: UnfinishedRunSet,
    workforce: Workforce,
    on_progress: Callable[[int], None],
    tell: Callable[[str], None],
) -> str:
    """Make every chunk that is missing; return the hash of all."""
    digests, chunks = unfinished.finished(), unfinished.chunks
    kept = sum(len(chunks[chunk]) for chunk in digests)
    if kept:
        tell(f"continuing: {kept} of {unfinished.plan.size} runs were there")
        on_progress(kept)
    missing = [chunk for chunk in range(len(chunks)) if chunk not in digests]
    if missing:
        with workforce.map(partial(make_chunk, unfinished), missing) as made:
            for chunk, digest in zip(missing, made, strict=True):
                digests[chunk] = digest
                on_progress(len(chunks[chunk]))
    whole = "".join(digests[chunk] for chunk in range(len(chunks)))
    return hashlib.sha256(whole.encode()).hexdigest()


def _manifest(plan: Plan, chunk_runs: int) -> dict[str, Any]:
    return {
        **plan.manifest(),
        "runs": plan.size,
        "runs_per_chunk": chunk_runs,
        "versions": {**versions(), "python": platform.python_version()},
    }


def versions() -> dict[str, str]:
    """Return the versions that every process must share for bytes to be the same."""
    others = {name: import_module(name).__version__ for name in DECISIVE}
    return {"failuretwin": __version__, **others}


def _listed(found: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in found.items())


def _encoding(values: xr.Variable, chunk_runs: int) -> dict[str, Any]:
    """Return how a variable that differs from run to run is stored."""
    from zarr.codecs import BloscCodec

    codec = BloscCodec(cname="lz4", clevel=COMPRESSION_LEVEL, shuffle="shuffle", typesize=8)
    return {
        "chunks": (chunk_runs, *values.shape[1:]),
        # Dots, not folders: every variable is one flat folder, made before the first chunk.
        "chunk_key_encoding": {"name": "default", "separator": "."},
        "compressors": (codec,) if values.dtype.kind == "f" else "auto",
    }
