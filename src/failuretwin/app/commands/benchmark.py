"""`failuretwin benchmark` and `failuretwin data`: entries on equal terms, and their data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from failuretwin.app.commands import options as opt
from failuretwin.app.terminal import Table, progress_bar, show, tell
from failuretwin.core.errors import InputError, check_name, counted

if TYPE_CHECKING:
    from failuretwin.decision.benchmark.runner import Work

data_option = opt.file_option("--data", "DIR", "Folder of all data.", default="benchmark-data")


def names_option(flag: str, text: str) -> Callable[[opt.F], opt.F]:
    """Return an option that takes names separated by commas."""
    return click.option(flag, metavar="NAME,...", help=f"{text} Default: all.")


@click.group()
def benchmark() -> None:
    """Score a diagnosis method on the same data as others, and show the table."""


@benchmark.command("list")
def list_() -> None:
    """Show the tasks, the tracks and the entries that come with the package."""
    from failuretwin.decision.benchmark.entries import BASELINES
    from failuretwin.decision.benchmark.simulated import ARMS
    from failuretwin.decision.benchmark.tasks import CASES, TASKS, TRACKS

    tasks = [
        (name, task.question, ", ".join(CASES[case].track for case in task.cases))
        for name, task in TASKS.items()
    ]
    show(
        Table(("task", "question", "tracks"), tasks),
        Table(("track", "what may be used"), list(TRACKS.items())),
        f"arms: {', '.join(ARMS)}",
        f"entries: {', '.join(BASELINES)}, or module:Class",
    )


def _work(tasks: str | None, arms: str | None, tracks: str | None, data: Path) -> list[Work]:
    """Return the cases of a part of the benchmark.

    Recorded runs are left out, with a note, where they are not there.
    """
    from failuretwin.decision.benchmark.runner import wanted_work
    from failuretwin.decision.benchmark.simulated import ARMS
    from failuretwin.decision.benchmark.tasks import REAL, TASKS, TRACKS

    chosen = _chosen("task", tasks, list(TASKS))
    if tasks is None and not (data / REAL).is_dir():
        chosen.remove("real")
        tell(
            f"note: task real is left out: {data / REAL} is not there. Fetch it: "
            f"failuretwin data fetch {REAL} --data {data}",
            err=True,
        )
    of_arms = _chosen("arm", arms, list(ARMS))
    found = wanted_work(chosen, of_arms, _chosen("track", tracks, list(TRACKS)), data)
    if not found:
        raise InputError("no case has all of these tasks, arms and tracks. See benchmark list.")
    return found


def _chosen(kind: str, text: str | None, valid: Sequence[str]) -> list[str]:
    names = list(valid) if text is None else [name.strip() for name in text.split(",")]
    for name in names:
        check_name(kind, name, valid)
    return names


work_options = opt.gathered(
    _work,
    "work",
    names_option("--tasks", "Tasks."),
    names_option("--arms", "Arms."),
    names_option("--tracks", "Tracks."),
    data_option,
)


@benchmark.command()
@click.option(
    "--method", required=True, metavar="NAME|MODULE:CLASS", help="Entry; see benchmark list."
)
@opt.file_option("--out", "DIR", "Folder for answers and results.", required=True)
@work_options
def run(method: str, out: Path, work: list[Work]) -> None:
    """Run an entry: a scikit-learn classifier, or a class with diagnose(runs).

    Data are made from fixed seeds and checked. Cases that were answered before are kept.
    """
    from failuretwin.app.reports.benchmark_page import score_table
    from failuretwin.decision.benchmark.runner import RESULTS, run_entry

    kept = sum(one.answers_in(out).exists() for one in work)
    if kept:
        tell(f"note: {counted(kept, 'answered case')} of {out} kept, not answered anew", err=True)
    with progress_bar("cases", len(work)) as advance:
        results = run_entry(method, work, out, advance)
    if not results["scores"]:
        raise InputError(f"{method}: takes part in none of these cases. Choose other tracks.")
    show(score_table(results))
    tell(f"written to {out / RESULTS}")


@benchmark.command("submit-file")
@click.argument("results", type=opt.PATH, metavar="DIR")
@click.option("--name", required=True, help="Name of the entry in the table.")
@opt.file_option("--out", "FILE.json", "File to write.", required=True)
@data_option
def submit_file(results: Path, name: str, out: Path, data: Path) -> None:
    """Write one file with scores and all answers of a run, scored again from the answers."""
    from failuretwin.decision.benchmark.runner import pack

    count = pack(results, name, data, out)
    tell(f"{counted(count, 'score')} of {name!r} written to {out}")


@benchmark.command()
@click.argument("files", nargs=-1, type=opt.PATH, metavar="[FILE.json|DIR]...")
@opt.file_option("--out", "DIR", "Folder for the page.", required=True)
@data_option
def page(files: tuple[Path, ...], out: Path, data: Path) -> None:
    """Write a page with the table of these results beside those of the bundled entries.

    Files of submit-file are scored again from their answers.
    """
    from failuretwin.app.reports.benchmark_page import write_benchmark_page
    from failuretwin.decision.benchmark.runner import RESULTS, read_submission, scored_again

    paths = [file / RESULTS if file.is_dir() else file for file in files]
    entries = [scored_again(read_submission(path), path, data) for path in paths]
    tell(f"written to {write_benchmark_page(entries, out)}")


@click.group()
def data() -> None:
    """Make the simulated data of the benchmark, or fetch recorded ones from their source."""


@data.command()
@click.argument("names", nargs=-1, metavar="[SET]...")
@opt.file_option(
    "--from source", "FOLDER|FILE.tar.gz", "Copy of a recorded set, in place of the public one."
)
@data_option
def fetch(names: tuple[str, ...], source: Path | None, data: Path) -> None:
    """Fill the data folder and check every file; without a SET: show what there is.

    SET is `simulated` or a recorded set. Files are known by their SHA-256, in any folders.
    """
    from failuretwin.decision.benchmark import real, simulated

    sets = real.real_sets()
    if not names:
        opt.refuse_unused("no set is named", "source")
        rows = [
            (name, one.content, f"{one.repository} {one.commit[:7]}", one.licence)
            for name, one in sets.items()
        ]
        rows.append(("simulated", "runs of four arms, from fixed seeds", "this package", "MIT"))
        show(Table(("set", "content", "source", "licence"), rows))
        return
    for name in names:
        check_name("set", name, [*sets, "simulated"])
    if "simulated" in names:
        opt.refuse_unused("simulated sets are made here", "source")
    for name in names:
        if name != "simulated":
            new = real.fetch(name, data, source)
            tell(f"{name}: {counted(len(sets[name].files), 'file')} as published, {new} new")
            continue
        official = simulated.official()
        with progress_bar("data sets", len(official)) as advance:
            for key in official:
                arm, _, part = key.partition("/")
                simulated.load_set(arm, part, data)
                advance(1)
        tell(f"simulated: {len(official)} data sets as published")
