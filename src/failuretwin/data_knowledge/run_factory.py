"""Run sets of any size: made piece by piece, straight to Zarr, by one process or many.

Whoever makes a piece writes it, so memory does not grow with the number of runs. Pieces, and with
them all bytes, are the same for any number of workers. Work that was cut short is continued.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from failuretwin.core.errors import FailureTwinError, InputError, OutputError
from failuretwin.data_knowledge.generation import CHUNK_RUNS, simulate, simulate_runs
from failuretwin.data_knowledge.lock import sole_writer
from failuretwin.data_knowledge.plan import Plan
from failuretwin.data_knowledge.run_pieces import Job, make_piece, versions
from failuretwin.data_knowledge.store import check_destination, reason, save_run_set
from failuretwin.data_knowledge.unfinished import take_up, whole_digest
from failuretwin.data_knowledge.workforce import ONE_PROCESS, Workforce
from failuretwin.data_knowledge.zarr_layout import layout_of

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
