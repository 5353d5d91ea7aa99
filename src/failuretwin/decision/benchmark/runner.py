"""Running an entry through the cases, and its file of results.

Answers to each case lie in a file of their own, so an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from failuretwin import __version__
from failuretwin.core.config import from_table
from failuretwin.core.errors import InputError, check_name, counted
from failuretwin.core.foreign import read_text, reading
from failuretwin.core.progress import Progress
from failuretwin.core.runs import concatenate
from failuretwin.data_knowledge.readers.read import ReadOptions, read_runs
from failuretwin.data_knowledge.store import write_text
from failuretwin.decision.benchmark import simulated
from failuretwin.decision.benchmark.entries import NotEnteredError, entry_of, named_runs
from failuretwin.decision.benchmark.real import folders_of, sha256
from failuretwin.decision.benchmark.tasks import (
    CASES,
    REAL,
    TASKS,
    Answers,
    Case,
    Judgement,
    Score,
)
from failuretwin.decision.evaluation import Truths
from failuretwin.decision.results import read_results, write_json_lines
from failuretwin.digital_model.robot import load_robot
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr

RESULTS, ANSWERS = "results.json", "answers"
DIGITS = 4
"""Decimals of all scores: the same on every machine."""
REAL_ARM = "armpi_fpv"
HEALTHY_LABELS = tuple(f"label_{label}" for label in range(5))
"""Sessions that a healthy robot recorded; stuck motors were made afterwards."""


@dataclass(frozen=True)
class Fold:
    """Runs that an entry learns from, and runs that it then answers.

    Attributes:
        known: Runs to learn from; without `fault`: of unknown state.
        test: Test runs with their truth.
    """

    known: tuple[xr.Dataset, ...]
    test: xr.Dataset


@dataclass(frozen=True)
class Work:
    """One case of one arm."""

    arm: str
    case: str
    data: Path

    @property
    def name(self) -> str:
        """Name of the file of answers, without suffix."""
        return f"{self.arm}-{self.case}"

    @property
    def plan(self) -> Case:
        """The case."""
        return CASES[self.case]

    @cached_property
    def folds(self) -> list[Fold]:
        """Parts of the case; an entry is made anew for each."""
        if self.plan.test == REAL:
            return list(self._sessions())
        test = simulated.load_set(self.arm, self.plan.test, self.data)
        if self.plan.until_s is not None:
            test = _until(test, self.plan.until_s)
        if self.plan.track == "P1":
            return [Fold((self._public(test),), test)]
        known = [simulated.load_set(self.arm, name, self.data) for name in self.plan.known]
        same = len({runs.attrs["individual"] for runs in known}) == 1
        together = (concatenate(known).assign_attrs(known[0].attrs),) if known and same else ()
        return [Fold(together, test)]

    def _sessions(self) -> Iterator[Fold]:
        robot, sessions = load_robot(self.arm), folders_of(REAL, self.data)
        runs = read_runs(sessions, robot, ReadOptions(published_labels=True))
        session_of = [str(name).partition("/")[0] for name in runs["run"].values]
        runs = runs.assign_coords(session=("run", session_of)).assign_attrs(individual="real")
        runs = simulated.shuffled(runs, f"{self.arm}-real")  # names of sessions hold labels
        if self.plan.track != "P0c":
            test = runs.drop_vars("session")
            yield Fold((self._public(test),) if self.plan.track == "P1" else (), test)
            return
        healthy = [session for session in sessions if session.name.endswith(HEALTHY_LABELS)]
        for session in sessions:
            known = read_runs([other for other in healthy if other != session], robot)
            truth = ["healthy"] * known.sizes["run"]
            known = known.assign(fault=("run", truth)).assign_attrs(individual="real")
            test = runs.isel(run=runs["session"].values == session.name)
            yield Fold((known,), test.drop_vars("session"))

    def _public(self, runs: xr.Dataset) -> xr.Dataset:
        """Return what an entry may see of test runs."""
        seen = runs[["command", "measured", "duration"]]
        names = [str(h) for h in simulated.classes_of(self.arm)]
        return named_runs(seen, [*names, "unknown"] if self.plan.unknown else names)

    def answers_in(self, out: Path) -> Path:
        """Return the file of answers in the folder of an entry."""
        return out / ANSWERS / f"{self.name}.jsonl"

    def answer(self, method: str, path: Path) -> bool:
        """Write an entry's answers; return whether it takes part in the case."""
        twin, found = DigitalTwin(load_robot(self.arm)), []
        train = partial(simulated.load_set, self.arm, "train", self.data)
        for fold in self.folds:
            entry = entry_of(method, twin, train)
            try:
                for runs in fold.known:
                    entry.fit(runs)
            except NotEnteredError:
                return False
            found += entry.diagnose(self._public(fold.test))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json_lines(found, path)
        return True

    @property
    def truths(self) -> Truths:
        """The truth of all test runs."""
        each = [Truths.of(fold.test, self.case).by_run for fold in self.folds]
        return Truths(self.case, {run: truth for part in each for run, truth in part.items()})


def _until(runs: xr.Dataset, end_s: float) -> xr.Dataset:
    """Return the beginning of runs."""
    seen = runs.isel(time=runs["time"].values < end_s)
    duration = runs["duration"].clip(max=float(seen["time"].values[-1]))
    return seen.assign(duration=duration)


def wanted_work(
    tasks: Sequence[str], arms: Sequence[str], tracks: Sequence[str], data: Path
) -> list[Work]:
    """Return the cases of tasks, arms and tracks; recorded runs are of one arm."""
    names = dict.fromkeys(
        name
        for task in tasks
        for case in TASKS[task].cases
        if CASES[case].track in tracks
        for name in (case, *TASKS[task].parts)
    )
    return [
        Work(arm, name, data)
        for arm in arms
        for name in names
        if CASES[name].test != REAL or arm == REAL_ARM
    ]


def run_entry(
    method: str, work: Sequence[Work], out: Path, on_progress: Progress
) -> dict[str, Any]:
    """Answer the cases that have no answers yet in `out`; return and write the results of all.

    Raises:
        InputError: If `out` holds the results of another entry or of other data.
    """
    results = _begun(method, out)
    for one in work:
        path = one.answers_in(out)
        if not path.exists():
            start = time.perf_counter()
            if one.answer(method, path):
                results["seconds"][one.name] = round(time.perf_counter() - start, 2)
                _write(results, out)
        on_progress(1)
    every = [Work(arm, case, work[0].data) for arm in simulated.ARMS for case in CASES]
    answered = [one for one in every if one.answers_in(out).exists()]
    results["scores"] = list(_scored(answered, out))
    results["answers"] = {
        path.name: sha256(path.read_bytes()) for path in sorted((out / ANSWERS).glob("*.jsonl"))
    }
    _write(results, out)
    return results


def _begun(method: str, out: Path) -> dict[str, Any]:
    header = {"benchmark": simulated.VERSION, "method": method}
    path = out / RESULTS
    if not path.exists():
        new = {**header, "failuretwin_version": __version__}
        return {**new, "seconds": {}, "scores": [], "answers": {}}
    stored = read_submission(path)
    if {key: stored[key] for key in header} != header:
        raise InputError(
            f"{path}: holds results of {stored['method']!r} on benchmark {stored['benchmark']}. "
            "Choose another --out."
        )
    return stored


def _write(results: Mapping[str, Any], out: Path) -> None:
    write_text(json.dumps(results, indent=1), out / RESULTS)


def _scored(work: Sequence[Work], out: Path) -> Iterator[dict[str, Any]]:
    """Yield every score of the cases that were answered."""
    for one in work:
        for key, task in TASKS.items():
            cases = (one.case, *task.parts)
            files = [Work(one.arm, case, one.data).answers_in(out) for case in cases]
            if one.case not in task.cases or not all(path.exists() for path in files):
                continue
            truths = one.truths
            answers, *others = [_answers(path, truths) for path in files]
            parts = dict(zip(task.parts, others, strict=True))
            for score in task.score(Judgement(answers, truths, parts)):
                where = {"task": key, "arm": one.arm, "case": one.case, "track": one.plan.track}
                yield where | _rounded(score)


def _answers(path: Path, truths: Truths) -> Answers:
    """Return the answers of a file, one to each run of the case."""
    answers = read_results(path).diagnoses
    found, expected = sorted(answer.run for answer in answers), sorted(truths.by_run)
    if found != expected:
        missing = len(set(expected) - set(found))
        raise InputError(
            f"{path}: holds {counted(len(found), 'answer')}, and none to {missing} of the "
            f"{len(expected)} runs. Expected one to each. Remove it and run the entry again."
        )
    return answers


def _rounded(score: Score) -> dict[str, Any]:
    table = asdict(score)
    for name in ("value", "low", "high"):
        number = float(table[name])
        table[name] = round(number, DIGITS) if math.isfinite(number) else None
    return table | {"infinite": math.isinf(score.value)}


# Files of results, also of other people.


@dataclass(frozen=True)
class StoredScore:
    """One score of a file; None: it does not exist, or is `infinite`."""

    task: str
    arm: str
    case: str
    track: str
    metric: str
    runs: int
    value: float | None = None
    low: float | None = None
    high: float | None = None
    infinite: bool = False


KEYS = ("benchmark", "method", "failuretwin_version", "seconds", "scores", "answers")


def read_submission(path: Path) -> dict[str, Any]:
    """Return a file of results.

    Raises:
        InputError: If it is none, or of another version of the benchmark.
    """
    expected = "Expected a file that `failuretwin benchmark run` or `submit-file` wrote."
    with reading(path, "results of the benchmark", expected):
        stored = json.loads(read_text(path, "results of the benchmark"))
        missing = [key for key in KEYS if key not in stored]
        if missing:
            raise InputError(f"{path}: lacks {', '.join(missing)}. {expected}")
        for place, score in enumerate(stored["scores"]):
            known = {key: value for key, value in score.items() if value is not None}
            from_table(StoredScore, known, f"{path}: score {place}")
    if stored["benchmark"] != simulated.VERSION:
        raise InputError(
            f"{path}: is of benchmark {stored['benchmark']}, expected {simulated.VERSION}. Run the "
            "entry again."
        )
    return dict(stored)


def pack(out: Path, name: str, data: Path, path: Path) -> int:
    """Write one file with the results in `out`, scored again, and all answers.

    Returns the number of scores.

    Raises:
        InputError: If there are no scores, or answers were changed after the run.
    """
    if not (out / RESULTS).is_file():
        raise InputError(f"{out}: has no {RESULTS}. Expected the --out of `benchmark run`.")
    results = read_submission(out / RESULTS)
    fix = "Run the entry again."
    answers = {file: read_text(out / ANSWERS / file, "answers", fix) for file in results["answers"]}
    for file, expected in results["answers"].items():
        if sha256(answers[file].encode()) != expected:
            raise InputError(
                f"{out / ANSWERS / file}: was changed after the run. Remove it and run the entry "
                "again."
            )
    packed = scored_again({**results, "name": name, "texts": answers}, out, data)
    if not packed["scores"]:
        raise InputError(f"{out}: has no scores. Expected answers to all cases of one task.")
    write_text(json.dumps(packed, indent=1), path)
    return len(packed["scores"])


def scored_again(stored: Mapping[str, Any], path: Path, data: Path) -> dict[str, Any]:
    """Return results with the scores of their own answers; without answers, as they are.

    Raises:
        InputError: If the answers are to unknown cases, or not to all runs of a case.
    """
    texts = stored.get("texts")
    if texts is None:
        return dict(stored)
    work = [_work_of(file, path, data) for file in texts]
    with TemporaryDirectory() as folder:
        for one, text in zip(work, texts.values(), strict=True):
            one.answers_in(Path(folder)).parent.mkdir(exist_ok=True)
            write_text(str(text), one.answers_in(Path(folder)))
        return {**stored, "scores": list(_scored(work, Path(folder)))}


def _work_of(file: str, path: Path, data: Path) -> Work:
    """Return the case that a file of answers is of."""
    arm, _, case = file.removesuffix(".jsonl").partition("-")
    check_name("arm", arm, simulated.ARMS, f"{path}: answers: ")
    check_name("case", case, CASES, f"{path}: answers: ")
    return Work(arm, case, data)
