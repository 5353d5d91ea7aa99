"""Run sets of any size, made chunk by chunk in a Zarr store by one process or many.

The process that makes a chunk writes it, so memory does not grow with the number of runs. All bytes
are the same for any number of workers. Interrupted work is continued.
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin import __version__
from failuretwin.core.config import fingerprint
from failuretwin.core.errors import FailureTwinError, InputError, OutputError, reason
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
"""File that makes a folder a Zarr group: the last one to be written."""
COMPRESSION_LEVEL = 5
DECISIVE = ("numpy", "scipy", "zarr", "numcodecs")
"""Packages, beside ourselves, whose versions may change bytes of a run set."""
LARGEST_NETCDF_BYTES = 600_000_000
"""Largest run set written as NetCDF; memory needed is about twice that."""


def versions() -> dict[str, str]:
    """Return the versions that every process must share for bytes to be the same."""
    others = {name: import_module(name).__version__ for name in DECISIVE}
    return {"failuretwin": __version__, **others}


# A run set in the making, in a hidden folder beside its destination.


@dataclass(frozen=True)
class Generation:
    """A run set in the making, with all that a worker needs to make a chunk of it.

    The folder holds the Zarr store, without the file that would make it readable; a mark with the
    hash of every chunk that is done; and the manifest.

    Attributes:
        plan: Robot, faults, imperfections and seed of the runs.
        folder: The hidden folder, an absolute path.
        chunk_runs: Runs in a chunk.
        versions: Versions that a worker must have.
        chunk_files: File of each variable's first chunk within the store, by the variable's name.
    """

    plan: Plan
    folder: Path
    chunk_runs: int
    versions: Mapping[str, str]
    chunk_files: Mapping[str, str]

    @property
    def store(self) -> Path:
        """The run set in the making."""
        return self.folder / "store"

    @property
    def chunks(self) -> range:
        """Numbers of the chunks."""
        return range(-(-self.plan.size // self.chunk_runs))

    def runs_of(self, chunk: int) -> range:
        """Return the numbers of the runs in a chunk."""
        first = chunk * self.chunk_runs
        return range(first, min(first + self.chunk_runs, self.plan.size))

    def mark(self, chunk: int) -> Path:
        """Return the file that holds the hash of a finished chunk."""
        return self.folder / "done" / str(chunk)

    def digest(self, chunk: int) -> str:
        """Return the hash of a chunk: SHA-256 over name, NUL, size, NUL, bytes of its files."""
        total = hashlib.sha256()
        for name in sorted(f.replace("/c.0", f"/c.{chunk}") for f in self.chunk_files.values()):
            if (self.store / name).is_file():  # one that was lost gives another hash
                data = (self.store / name).read_bytes()
                total.update(f"{name}\0{len(data)}\0".encode() + data)
        return total.hexdigest()

    def finished(self) -> dict[int, str]:
        """Return the hash of every finished chunk; a mark that does not fit is removed."""
        found = {}
        for mark in (self.folder / "done").iterdir():
            digest = self.digest(int(mark.name))
            if mark.read_text() == digest:
                found[int(mark.name)] = digest
            else:
                mark.unlink()
        return found

    def kept_runs(self) -> int:
        """Return the number of runs in chunks that are marked as finished."""
        marks = (self.folder / "done").glob("*")
        return sum(len(self.runs_of(int(mark.name))) for mark in marks if mark.stat().st_size)

    def finish(self, manifest: Mapping[str, Any], path: Path) -> None:
        """Make the store readable and put it in the place of `path`.

        Raises:
            OSError: If that cannot be done; `path` is as before.
        """
        for torn in self.store.rglob("*.partial"):  # of a process that was killed as it wrote
            torn.unlink()
        (self.store / MANIFEST).write_bytes(_to_json(manifest))
        shutil.copyfile(self.folder / GROUP, self.store / GROUP)
        atomic_replace(self.store, path)
        self.remove()

    def remove(self) -> None:
        """Remove all of it."""
        shutil.rmtree(self.folder, ignore_errors=True)


def make_chunk(generation: Generation, chunk: int) -> str:
    """Make a chunk and write it; return the hash of its files.

    Every file appears whole, so it does no harm if two processes make the same chunk.

    Raises:
        InputError: If this process has other versions than the one that asks, or cannot see
            where the run set is made.
        OSError: If the chunk cannot be written.
    """
    import zarr

    if versions() != generation.versions:
        raise InputError(
            f"worker on {platform.node()} has {_listed(versions())}, expected "
            f"{_listed(generation.versions)}. Install the same versions there."
        )
    if not generation.folder.is_dir():
        raise InputError(
            f"worker on {platform.node()} sees no {generation.folder}. Write to a folder that "
            "all workers share under the same path."
        )
    runs = generation.runs_of(chunk)
    part = simulate_runs(generation.plan, runs).to_dataset()
    with writing_zarr():
        for name in generation.chunk_files:
            array = zarr.open_array(generation.store / name, mode="r+")
            array[runs.start : runs.stop] = part[name].values
    digest = generation.digest(chunk)
    generation.mark(chunk).write_text(digest)
    return digest


def _listed(found: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in found.items())


def _to_json(value: Mapping[str, Any]) -> bytes:
    return (json.dumps(value, indent=2, sort_keys=True) + "\n").encode()


# The store without its runs.


def _encoding(example: xr.Dataset, chunk_runs: int) -> dict[str, dict[str, Any]]:
    """Return how every variable that differs from run to run is stored, by its name."""
    from zarr.codecs import BloscCodec

    codec = BloscCodec(cname="lz4", clevel=COMPRESSION_LEVEL, shuffle="shuffle", typesize=8)
    encoding: dict[str, dict[str, Any]] = {}
    for name, variable in example.variables.items():
        if variable.dims[:1] != ("run",):
            continue
        encoding[str(name)] = {
            "chunks": (chunk_runs, *variable.shape[1:]),
            # Dots, not folders: every variable is one flat folder, made before the first chunk.
            "chunk_key_encoding": {"name": "default", "separator": "."},
        }
        if variable.dtype.kind == "f":
            encoding[str(name)]["compressors"] = (codec,)
    return encoding


def _open(plan: Plan, path: Path, chunk_runs: int) -> tuple[Generation, dict[str, Any]]:
    """Return the generation for `path`, new or as an earlier process left it, and its manifest.

    Unfinished work of another plan for `path` is removed.

    Raises:
        OSError: If a folder cannot be made.
    """
    manifest = {
        **plan.manifest(),
        "runs": plan.size,
        "runs_per_chunk": chunk_runs,
        "versions": {**versions(), "python": platform.python_version()},
    }
    folder = path.with_name(f".{path.name}.{fingerprint(manifest)[:16]}.partial")
    pattern = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{16}}\.partial")
    for other in path.parent.iterdir():
        if pattern.fullmatch(other.name) and other != folder:
            shutil.rmtree(other)
    example = simulate_runs(plan, [0]).to_dataset()
    encoding = _encoding(example, chunk_runs)
    files = {name: f"{name}/c.0" + ".0" * (example[name].ndim - 1) for name in encoding}
    generation = Generation(plan, folder, chunk_runs, versions(), files)
    begun = generation.store.is_dir() and (folder / MANIFEST).is_file()
    if not begun or (folder / MANIFEST).read_bytes() != _to_json(manifest):
        _begin(generation, manifest, example, encoding)
    return generation, manifest


def _begin(
    generation: Generation,
    manifest: Mapping[str, Any],
    example: xr.Dataset,
    encoding: Mapping[str, Any],
) -> None:
    """Write all that does not depend on runs; the manifest comes last."""
    import zarr

    generation.remove()
    try:
        (generation.folder / "done").mkdir(parents=True)
        with writing_zarr():
            example.to_zarr(generation.store, mode="w", consolidated=False, encoding=encoding)
            for name, file in generation.chunk_files.items():
                array = zarr.open_array(generation.store / name, mode="r+")
                array.resize((generation.plan.size, *array.shape[1:]))
                (generation.store / file).unlink()  # the run of the example
            zarr.consolidate_metadata(str(generation.store))
        (generation.store / GROUP).rename(generation.folder / GROUP)
        (generation.folder / MANIFEST).write_bytes(_to_json(manifest))
    except OSError:
        generation.remove()
        raise


def produce(
    plan: Plan,
    path: Path,
    workforce: Workforce = ONE_PROCESS,
    on_progress: Callable[[int], None] = lambda runs: None,
    tell: Callable[[str], None] = lambda text: None,
    chunk_runs: int = CHUNK_RUNS,
) -> None:
    """Simulate all runs of a plan into a run set; continue where such work was cut short.

    Until the run set is complete, `path` is as before and finished chunks lie in a hidden folder
    beside it, from which the same call goes on. Memory does not depend on the number of runs.
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
        runs = simulate(plan, workforce.workers, on_progress, workforce.scheduler)
        save_run_set(runs, path)
        return
    target = path.resolve()  # a link stays a link
    try:
        with sole_writer(target):
            generation, manifest = _open(plan, target, chunk_runs)
            try:
                digests = _make_all(generation, workforce, on_progress, tell)
                whole = "".join(digests[chunk] for chunk in generation.chunks)
                content = hashlib.sha256(whole.encode()).hexdigest()
                generation.finish({**manifest, "content": content}, target)
            except BaseException:
                _leave(generation, tell)
                raise
    except OSError as error:
        if isinstance(error, FailureTwinError):
            raise
        raise OutputError(
            f"{path}: could not be written ({reason(error)}). Free some space or choose another "
            "place."
        ) from error


def _check_fits_memory(plan: Plan, path: Path) -> None:
    each = simulate_runs(plan, [0]).to_dataset().nbytes
    if plan.size * each > LARGEST_NETCDF_BYTES:
        raise InputError(
            f"{path}: {plan.size} runs are {plan.size * each / 1e6:.0f} MB, and NetCDF is made in "
            f"memory, up to {LARGEST_NETCDF_BYTES / 1e6:.0f} MB. Write to "
            f"{path.with_suffix('.zarr').name}, which has no such limit."
        )


def _make_all(
    generation: Generation,
    workforce: Workforce,
    on_progress: Callable[[int], None],
    tell: Callable[[str], None],
) -> dict[int, str]:
    """Make every chunk that is missing; return the hashes of all."""
    digests = generation.finished()
    kept = generation.kept_runs()
    if kept:
        tell(f"continuing: {kept} of {generation.plan.size} runs were there")
        on_progress(kept)
    missing = [chunk for chunk in generation.chunks if chunk not in digests]
    if missing:
        with workforce.map_unordered(partial(make_chunk, generation), missing) as results:
            for chunk, digest in results:
                digests[chunk] = digest
                on_progress(len(generation.runs_of(chunk)))
    return digests


def _leave(generation: Generation, tell: Callable[[str], None]) -> None:
    """Keep the finished chunks, if any, and say so."""
    kept = generation.kept_runs()
    if kept:
        tell(
            f"{kept} of {generation.plan.size} runs are kept in {generation.folder}; the same "
            "command goes on from there"
        )
    else:
        generation.remove()
