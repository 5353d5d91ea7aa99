"""Run sets of any size, made chunk by chunk in a Zarr store by one process or many.

The process that makes a chunk writes it, so memory does not grow with the number of runs. All bytes
are the same for any number of workers. Interrupted work is continued.
"""

from __future__ import annotations

import platform
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin.core.errors import InputError
from failuretwin.core.progress import Progress, unseen
from failuretwin.core.runs import VARIABLES
from failuretwin.data_knowledge.generate import CHUNK_RUNS, Plan, simulate, simulate_runs
from failuretwin.data_knowledge.pieces import Unfinished, hidden_folder, versions
from failuretwin.data_knowledge.store import (
    check_destination,
    save_run_set,
    writing_zarr,
)
from failuretwin.data_knowledge.workers import ONE_PROCESS, Workforce

if TYPE_CHECKING:
    import xarray as xr

MANIFEST = "manifest.json"
GROUP = "zarr.json"
"""File that makes a folder a Zarr group; it comes last, so that unfinished work is unreadable."""
COMPRESSION_LEVEL = 5
KEY_ENDS = {"run": "", **{name: ".0" * (len(dims) - 1) for name, (dims, _) in VARIABLES.items()}}
"""Ends of the file names of a chunk, by the variables that differ from run to run."""
LARGEST_NETCDF_BYTES = 600_000_000
"""Largest run set written as NetCDF; memory needed is about twice that."""


def produce(
    plan: Plan,
    path: Path,
    workforce: Workforce = ONE_PROCESS,
    on_progress: Progress = unseen,
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
    folder = hidden_folder(path, _manifest(plan, chunk_runs))
    unfinished = UnfinishedRunSet(folder, versions(), plan, chunk_runs)
    unfinished.carry_out(path, workforce, on_progress, tell)


def _check_fits_memory(plan: Plan, path: Path) -> None:
    size = plan.size * simulate_runs(plan, [0]).to_dataset().nbytes
    if size > LARGEST_NETCDF_BYTES:
        raise InputError(
            f"{path}: {plan.size} runs are {size / 1e6:.0f} MB, and NetCDF is made in memory, up "
            f"to {LARGEST_NETCDF_BYTES / 1e6:.0f} MB. Write to {path.with_suffix('.zarr').name}, "
            "which has no such limit."
        )


@dataclass(frozen=True)
class UnfinishedRunSet(Unfinished):
    """A run set in the making.

    The folder holds the Zarr store, the file that will make it readable, and one mark per finished
    chunk, with its hash.

    Attributes:
        plan: Robot, faults, imperfections and seed of the runs.
        chunk_runs: Runs in a chunk.
    """

    plan: Plan
    chunk_runs: int

    @property
    def store(self) -> Path:
        """The Zarr store."""
        return self.folder / "store"

    @property
    def chunks(self) -> list[range]:
        """Numbers of the runs in each chunk."""
        return self.plan.chunks(self.chunk_runs)

    @property
    def sizes(self) -> list[int]:
        """Number of runs in each chunk."""
        return [len(chunk) for chunk in self.chunks]

    def files(self, piece: int) -> list[Path]:
        """Return the files that a chunk may have, in the order in which they are hashed."""
        return [self.store / name / f"c.{piece}{end}" for name, end in sorted(KEY_ENDS.items())]

    def make(self, piece: int) -> str:
        """Make a chunk and write it; return the hash of its files.

        Every file appears whole, so it does no harm if two processes make the same chunk.

        Raises:
            InputError: If this process has other versions than the one that asks, or cannot see
                where the run set is made.
            OSError: If the chunk cannot be written.
        """
        import zarr

        self.check_worker()
        runs = self.chunks[piece]
        part = simulate_runs(self.plan, runs).to_dataset()
        with writing_zarr():
            for name in KEY_ENDS.keys() & part.variables:
                array = zarr.open_array(self.store / name, mode="r+")
                array[runs.start : runs.stop] = part[name].values
        return self.mark(piece)

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
        """Make the store readable and put it in the place of `path`."""
        shutil.copyfile(self.folder / GROUP, self.store / GROUP)
        manifest = {**_manifest(self.plan, self.chunk_runs), "content": content}
        self.publish(self.store, manifest, MANIFEST, path)


def _manifest(plan: Plan, chunk_runs: int) -> dict[str, Any]:
    return {
        **plan.manifest(),
        "runs": plan.size,
        "runs_per_chunk": chunk_runs,
        "versions": {**versions(), "python": platform.python_version()},
    }


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
