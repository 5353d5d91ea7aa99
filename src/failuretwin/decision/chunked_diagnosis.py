"""Diagnosis of run sets of any size: piece by piece, by one process or many, into parquet files.

Memory does not grow with the number of runs. The same bytes are written for any number of workers,
and interrupted work is continued.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from failuretwin.core.config import fingerprint
from failuretwin.core.errors import OutputError
from failuretwin.core.progress import Progress, unseen
from failuretwin.core.runs import unique_names
from failuretwin.data_knowledge.pieces import Unfinished, hidden_folder, versions
from failuretwin.data_knowledge.readers.read import ReadOptions
from failuretwin.data_knowledge.run_pieces import RunPieces
from failuretwin.data_knowledge.store import check_fillable
from failuretwin.data_knowledge.workers import Workforce
from failuretwin.decision.results import (
    check_parquet,
    part_name,
    read_names,
    rename_runs,
    write_part,
)
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.explanation import with_learned_method, with_reading_doubt
from failuretwin.inference.observation.computed_tool import is_computed
from failuretwin.inference.prepared import PreparedDiagnoser, parts_of
from failuretwin.inference.set_ups.log_correction import LogCorrection

MANIFEST = "_manifest.json"
"""Pandas and the like skip such a name where they open the folder as one table."""
PACKAGES = ("numpy", "scipy", "xarray", "zarr", "pyarrow")
"""Packages whose versions may change bytes of the results."""


def diagnose_to_parquet(
    runs: RunPieces | str | Path | Sequence[str | Path],
    bayes: BayesDiagnoser,
    folder: str | Path,
    correction: LogCorrection | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    on_progress: Progress = unseen,
    tell: Callable[[str], None] = lambda text: None,
) -> None:
    """Diagnose runs of any number into a folder of parquet files; continue interrupted work.

    What all runs share, such as a wrong unit or clock, is judged by at most 128 of them, evenly
    spread. Until all runs are diagnosed, `folder` is as before and finished files lie in a hidden
    folder beside it, from which the same call continues.

    Args:
        runs: The runs, or the path of anything that `read_runs` reads.
        bayes: The diagnoser.
        folder: Where the results go; a folder of results of that name is replaced at the end.
        correction: Set-up to undo in all runs; None: none.
        workers: Processes to spread the work over; the results do not depend on it. Scripts that
            ask for several must be guarded by ``if __name__ == "__main__":``.
        scheduler: Address of a Dask scheduler whose workers do it instead.
        on_progress: Called with the number of further runs (or logs) that are finished.
        tell: Called with one line about an earlier attempt, or about this one if it fails.

    Raises:
        InputError: If runs cannot be read or do not fit the robot, pyarrow is missing, or the
            workforce cannot be had.
        OutputError: If the results cannot be written.
    """
    check_parquet()
    folder, workforce = Path(folder), Workforce(workers, scheduler)
    _check_results_folder(folder)
    if not isinstance(runs, RunPieces):
        sources = [runs] if isinstance(runs, str | Path) else runs
        runs = RunPieces([Path(source) for source in sources], bayes.twin.robot, ReadOptions())
    manifest = _manifest(runs, bayes, correction)
    if _is_complete(folder, fingerprint(manifest), len(runs.pieces)):
        tell(f"{folder}: holds these results already")
        return
    work = runs, bayes, correction, fingerprint(manifest)
    unfinished = UnfinishedResults(hidden_folder(folder, manifest), versions(*PACKAGES), *work)
    unfinished.carry_out(folder, workforce, on_progress, tell)


def _check_results_folder(folder: Path) -> None:
    """Raise OutputError unless results can be written to `folder`; other content stays."""
    check_fillable(folder)
    if folder.is_dir() and any(folder.iterdir()) and not (folder / MANIFEST).is_file():
        raise OutputError(
            f"{folder}: is a folder that holds something else than results. It is left alone; "
            "choose another name."
        )


def _is_complete(folder: Path, identity: str, pieces: int) -> bool:
    """Return whether a folder holds the results of the same runs, options and versions."""
    try:
        stated = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    there = all((folder / part_name(piece)).is_file() for piece in range(pieces))
    return there and isinstance(stated, dict) and stated.get("identity") == identity


def _manifest(
    runs: RunPieces, bayes: BayesDiagnoser, correction: LogCorrection | None
) -> dict[str, Any]:
    """Return all that decides what the results are."""
    return {
        "inputs": fingerprint(runs.stamps()),
        "options": fingerprint(runs.options),
        "diagnoser": fingerprint(bayes),
        "correction": fingerprint(correction),
        "pieces": [piece.size for piece in runs.pieces],
        "versions": versions(*PACKAGES),
    }


@dataclass(frozen=True)
class UnfinishedResults(Unfinished):
    """Results in the making.

    Attributes:
        runs: The runs.
        bayes: The diagnoser.
        correction: Set-up to undo in all runs; None: none.
        identity: Hash of all that decides what the results are.
    """

    runs: RunPieces
    bayes: BayesDiagnoser
    correction: LogCorrection | None
    identity: str

    @property
    def results(self) -> Path:
        """Folder of the files."""
        return self.folder / "results"

    @cached_property
    def sizes(self) -> Sequence[int]:
        """Number of runs, or of logs, in each piece."""
        return [piece.size for piece in self.runs.pieces]

    @property
    def unit(self) -> str:
        """What the pieces consist of."""
        return "runs" if all(piece.rows is not None for piece in self.runs.pieces) else "logs"

    def files(self, piece: int) -> list[Path]:
        """Return the file of a piece."""
        return [self.results / part_name(piece)]

    def begin(self) -> None:
        """Make the folders."""
        for folder in (self.results, self.marks):
            folder.mkdir(parents=True, exist_ok=True)

    def make(self, piece: int) -> str:
        """Diagnose a piece and write its file; return its hash.

        Raises:
            InputError: If this process has other versions than the one that asks, cannot see the
                folder, or the runs cannot be read.
            OSError: If the file cannot be written.
        """
        self.check_worker()
        (prepared, computed), runs = self._prepared, self.runs.read(piece)
        if self.correction is not None:
            runs = self.correction.runs(runs)
        self.bayes.check(runs)
        parts = parts_of(runs.sizes["run"])
        found = [
            diagnosis
            for part in parts
            for diagnosis in prepared.diagnose(runs.isel(run=slice(part.start, part.stop)))
        ]
        if computed:
            found = [with_reading_doubt(one, one.diagnosis or "") for one in found]
        if self.bayes.priors.fault_factors:
            found = [with_learned_method(one) for one in found]
        write_part(found, [str(h) for h in self.bayes.hypothesis_set], *self.files(piece))
        return self.mark(piece)

    @property
    def _prepared(self) -> tuple[PreparedDiagnoser, bool]:
        """The diagnoser whose set-up is judged, and whether tool paths are computed.

        A process works them out once.
        """
        if _known.get("identity") != self.identity:
            sample = self.runs.sample()
            if self.correction is not None:
                sample = self.correction.runs(sample)
            found = self.bayes.prepare(sample), is_computed(sample, self.bayes.twin)
            _known.update(identity=self.identity, prepared=found)
        return _known["prepared"]

    def finish(self, content: str, path: Path) -> None:
        """Name runs uniquely, and put the folder in the place of `path`."""
        self._rename()
        stated = {"content": content, "identity": self.identity, "versions": self.versions}
        self.publish(self.results, stated, MANIFEST, path)

    def _rename(self) -> None:
        """Number runs of the same name, as `read_runs` does."""
        files = [self.files(piece)[0] for piece in range(len(self.sizes))]
        names = [read_names(file) for file in files]
        unique = iter(unique_names([name for some in names for name in some]))
        for file, some in zip(files, names, strict=True):
            new = [next(unique) for _ in some]
            if new != some:
                rename_runs(file, new)


_known: dict[str, Any] = {}
"""What this process has prepared last."""
