"""One piece of a run set that many processes make: what it needs, and how it is made."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from importlib import import_module

from failuretwin import __version__
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.generation import simulate_runs
from failuretwin.data_knowledge.plan import Plan
from failuretwin.data_knowledge.unfinished import Unfinished
from failuretwin.data_knowledge.zarr_layout import piece_content

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
