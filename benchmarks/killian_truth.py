"""What is true of the runs of `killian_runs_dev`, from folder names and motor readings alone.

    python benchmarks/killian_truth.py FOLDER [--out benchmarks/killian_runs.csv]

FOLDER holds the two parts of the campaign. A row of the CSV is a run that is no copy of another:

run       its folder within FOLDER. Of copies the one in the percentage part is kept: a copied
          steady-state run is a percentage failure, whichever part it lies in.
truth     the true hypothesis. Names with "nofail" are healthy, "stuck_motor_k" is stuck; of
          "steady_motor_k" those of the percentage part are encoder_scale, the others encoder_bias.
seen      number of fully seen movements. A movement is fully seen if the readings begin before its
          command, go on past the next command without a silence of more than 0.5 s between, and
          the motor in question was read at rest (later than 0.15 s after its ramp). The last
          command of a log has no next one and is never fully seen.
errors    settled minus commanded position of the faulty motor [counts] in each of them: median of
          the sound readings at rest in the last 0.6 s. Empty for healthy runs.
judged    yes if the error exceeds 10 counts in two fully seen movements or more.

No diagnosis and no twin is involved.
"""

from __future__ import annotations

import argparse
import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import failuretwin as ft
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.readers.raw_sessions import (
    SESSION_FILES,
    RawSession,
    find_sessions,
    read_session,
)
from failuretwin.digital_model.robot import Robot

PERCENTAGE = "60_trajs_percentage_failure"
LEAST_ERROR_COUNTS = 10.0
LEAST_MOVEMENTS = 2
SILENCE_S = 0.5
REST_S = 0.15
WINDOW_S = 0.6
LIST = Path(__file__).with_name("killian_runs.csv")


@dataclass(frozen=True)
class TrueRun:
    """One row of the list; see the module.

    Attributes:
        run: Folder within the campaign.
        truth: True hypothesis.
        errors: Error of the faulty motor in each fully seen movement [counts].
        seen: Number of fully seen movements.
    """

    run: str
    truth: str
    errors: tuple[float, ...]
    seen: int

    @property
    def judged(self) -> bool:
        """Whether the fault is large enough, often enough, to be asked for."""
        large = [error for error in self.errors if abs(error) > LEAST_ERROR_COUNTS]
        return len(large) >= LEAST_MOVEMENTS


def main() -> None:
    """Write the list."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=LIST)
    options = parser.parse_args()
    robot = ft.load_robot("armpi_fpv")
    runs = [true_run(folder, options.folder, robot) for folder in distinct(options.folder)]
    with options.out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["run", "truth", "seen", "errors", "judged"])
        for run in runs:
            errors = " ".join(f"{error:g}" for error in run.errors)
            writer.writerow([run.run, run.truth, run.seen, errors, "yes" if run.judged else "no"])
    judged = sum(run.judged for run in runs)
    healthy = sum(run.truth == "healthy" for run in runs)
    print(f"{len(runs)} distinct runs, {healthy} healthy, {judged} judged: {options.out}")


def read_list(path: Path = LIST) -> list[TrueRun]:
    """Return the rows of the list."""
    with path.open(newline="", encoding="utf-8") as file:
        return [
            TrueRun(row["run"], row["truth"], _numbers(row["errors"]), int(row["seen"]))
            for row in csv.DictReader(file)
        ]


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(word) for word in text.split())


def distinct(campaign: Path) -> list[Path]:
    """Return one folder of each set of equal ones, that of the percentage part if it is there."""
    kept: dict[tuple[bytes, ...], Path] = {}
    for folder in find_sessions(campaign):
        content = tuple((folder / name).read_bytes() for name in SESSION_FILES)
        if content not in kept or folder.parent.name == PERCENTAGE:
            kept[content] = folder
    return sorted(kept.values())


def true_run(folder: Path, campaign: Path, robot: Robot) -> TrueRun:
    """Return what is true of one run."""
    session = read_session(folder, robot)
    truth = _truth(folder)
    motor = robot.motor_names.index(truth.partition(":")[0]) if ":" in truth else None
    settled = [_settled_error(session, robot, m, motor) for m in range(len(session.target_counts))]
    seen = [error for error in settled if error is not None]
    name = folder.relative_to(campaign).as_posix()
    return TrueRun(name, truth, () if motor is None else tuple(seen), len(seen))


def _truth(folder: Path) -> str:
    """Return the true hypothesis that the name of a folder tells."""
    if "nofail" in folder.name:
        return "healthy"
    found = re.search(r"_(stuck|steady)_(motor_[1-4])_", folder.name)
    if found is None:
        raise ValueError(f"{folder}: the name tells no fault")
    kind, motor = found.groups()
    steady = "encoder_scale" if folder.parent.name == PERCENTAGE else "encoder_bias"
    return f"{motor}:{'stuck' if kind == 'stuck' else steady}"


def _settled_error(
    session: RawSession, robot: Robot, movement: int, motor: int | None
) -> float | None:
    """Return the error of a motor at the end of a movement [counts], None if not fully seen.

    Without a motor the movement is looked at as a whole, and the error is 0.
    """
    stamps, at = session.command_time, session.reading_time
    if movement + 1 == len(stamps) or not at[0] <= stamps[movement]:
        return None
    start, end = float(stamps[movement]), float(stamps[movement + 1])
    if at[-1] < end or _longest_silence(at, start, end) > SILENCE_S:
        return None
    ramps = session.ramp_s[movement]
    rest = max(
        start + float(ramps.max() if motor is None else ramps[motor]) + REST_S, end - WINDOW_S
    )
    resting = (at >= rest) & (at < end)
    if motor is None:
        return 0.0 if resting.any() else None
    counts = session.reading_counts[resting, motor]
    counts = counts[robot.servo_units.valid(counts)]
    if counts.size == 0:
        return None
    return float(np.median(counts) - session.target_counts[movement, motor])


def _longest_silence(at: FloatArray, start: float, end: float) -> float:
    """Return the longest time between readings that touches a stretch [s]."""
    first = int(np.searchsorted(at, start, side="right")) - 1
    last = int(np.searchsorted(at, end))
    return float(np.diff(at[first : last + 1]).max())


if __name__ == "__main__":
    main()
