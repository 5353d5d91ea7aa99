"""`diagnose --parquet`: more runs than memory holds."""

from __future__ import annotations

from collections import Counter
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from failuretwin.app.inputs import with_map
from failuretwin.app.learning import Start, check_learning_from, self_calibrated
from failuretwin.app.reports.reports import score_parts
from failuretwin.app.terminal import Part, figures_table, progress_bar, tell
from failuretwin.core.errors import InputError, counted
from failuretwin.core.hypothesis import FAULTY_STATE, HEALTHY_STATE, OPEN_STATE
from failuretwin.data_knowledge.run_pieces import PIECE, RunPieces
from failuretwin.data_knowledge.workers import Workforce
from failuretwin.decision.chunked_diagnosis import diagnose_to_parquet
from failuretwin.decision.evaluation import Judged
from failuretwin.decision.results import read_diagnoses
from failuretwin.decision.scoring import NO_VERDICT
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.observation.sensors import sensing_of
from failuretwin.inference.set_ups.log_correction import LogCorrection

if TYPE_CHECKING:
    from datetime import datetime

    from failuretwin.app.commands.options import LogOptions
    from failuretwin.app.remembering import RobotRecord

STATES = (HEALTHY_STATE, FAULTY_STATE, OPEN_STATE)


def diagnose_many(
    reading: LogOptions,
    bayes: BayesDiagnoser,
    folder: Path,
    workforce: Workforce,
    start: Start | None,
    stored: RobotRecord | None,
    recorded: datetime | None,
) -> list[Part]:
    """Diagnose runs of any number into a folder of parquet files, and return a summary.

    Args:
        reading: The logs.
        bayes: How to diagnose.
        folder: The folder.
        workforce: Who does the work.
        start: What a calibration that is learned from a sample of the runs begins with; None: none
            is learned.
        stored: The robot in the store, which keeps the diagnoses; None: nothing does.
        recorded: When the log was recorded (UTC); None: when it was last modified.

    Raises:
        InputError: If the store should keep several logs.
    """
    if stored is not None and len(reading.logs) > 1:
        raise InputError(
            f"--parquet and --store take one LOG, got {len(reading.logs)}. Diagnose one after the "
            "other."
        )
    robot = bayes.twin.robot
    options, correction = with_map(reading.options, reading.columns, reading.logs, robot)
    runs = RunPieces(reading.logs, robot, options)
    if start is not None:
        bayes = _taught(runs, correction, bayes, start)
    with progress_bar("diagnosing", runs.size) as advance:
        diagnose_to_parquet(
            runs,
            bayes,
            folder,
            correction,
            workforce.workers,
            workforce.scheduler,
            advance,
            tell=lambda text: tell(text, err=True),
        )
    kept = [] if stored is None else [_remember(stored, folder, reading, recorded)]
    return [*_summary(folder), *kept]


def _taught(
    runs: RunPieces, correction: LogCorrection | None, bayes: BayesDiagnoser, start: Start
) -> BayesDiagnoser:
    """Return a diagnoser with what a sample of runs teaches of the robot, and say so."""
    sample = runs.sample()
    if correction is not None:
        sample = correction.runs(sample)
    check_learning_from(sensing_of(sample, None))
    found = self_calibrated(sample, bayes, start)
    taught = counted(sample.sizes["run"], "run")
    tell(f"self-calibrated by {taught}, evenly spread; each run is judged by what they teach")
    for line in found.lines:
        tell(line)
    return found.bayes


def _remember(
    stored: RobotRecord, folder: Path, reading: LogOptions, recorded: datetime | None
) -> str:
    """Store the diagnoses in a folder of results piece by piece, and return a line."""
    from failuretwin.data_knowledge.records.log_files import log_file  # needs the extra `store`

    log = log_file(reading.logs[0], recorded)
    added, known, rest = 0, 0, read_diagnoses(folder)
    while some := list(islice(rest, PIECE)):
        done = stored.remember(some, log, first=added + known)
        added, known = added + done.added, known + done.known
    return stored.remembered(counted(added, "run"), known)[0]


def _summary(folder: Path) -> list[Part]:
    """Return how many runs have each diagnosis, and scores where the truth is known."""
    diagnoses = list(read_diagnoses(folder, texts=False))
    found = Counter((d.diagnosis or NO_VERDICT, d.state) for d in diagnoses)
    total = Counter(d.diagnosis or NO_VERDICT for d in diagnoses)
    rows = [
        (name, str(total[name]), *(str(found[name, state]) for state in STATES))
        for name in sorted(total, key=lambda name: (-total[name], name))
    ]
    table = figures_table(("most probable", "runs", *STATES), rows)
    count = counted(len(diagnoses), "run")
    return [table, f"\n{count} diagnosed: {folder}", *score_parts(Judged.of(diagnoses))]
