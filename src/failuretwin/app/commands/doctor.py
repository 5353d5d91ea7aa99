"""`failuretwin doctor`: whether a log fits the profile of its robot, before anyone diagnoses it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from failuretwin.app.commands.options import (
    PATH,
    LogOptions,
    calibration_option,
    common_options,
    reading_options,
)
from failuretwin.app.terminal import show, tell

if TYPE_CHECKING:
    from failuretwin.inference.seen_runs import SeenRuns
    from failuretwin.inference.set_up_posterior import SetUpPosterior
    from failuretwin.inference.set_ups.set_ups import SetUp

SHOWN = 5
"""So many kinds of remarks on logs are listed."""
NAMED = 3
"""So many runs are named beside a remark."""


@click.command()
@click.argument("logs", nargs=-1, required=True, type=PATH, metavar="LOG...")
@calibration_option
@click.option(
    "--out",
    type=PATH,
    metavar="MAP.toml",
    help="Where to write what puts a wrong set-up right, beside what --columns says. Give it to "
    "any command as --columns MAP.toml once you believe it.",
)
@reading_options
@common_options
def doctor(
    logs: tuple[Path, ...],
    calibration: Path | None,
    out: Path | None,
    reading: LogOptions,
    robot: str,
    seed: int,
) -> None:
    """Say whether logs fit the profile: senses, order, units, axes, zeros, frames, clocks, grids.

    LOG is whatever `diagnose` reads, faulty or not; all are taken to share one set-up. Every
    mistake is weighed with every fault behind it, so that a broken motor is not taken for one.
    """
    del seed  # nothing here is drawn by chance
    from failuretwin.app.inputs import read_inputs
    from failuretwin.core.errors import InputError
    from failuretwin.digital_model.calibrated_robot import load_calibration
    from failuretwin.digital_model.robot import load_robot
    from failuretwin.inference.diagnoser import BayesDiagnoser

    if out is not None and (out.suffix != ".toml" or out.exists()):
        raise InputError(f"{out}: expected a name that ends in .toml and is not taken yet.")
    model = load_robot(robot)
    known = load_calibration(calibration, model)
    runs = read_inputs(logs, model, reading)
    seen = BayesDiagnoser(known.twin, known.imperfections).seen(runs)
    set_ups = seen.set_ups()
    unfit = _unfit(seen, set_ups)
    undo = set_ups.best.set_up if set_ups.fits else None
    frame = seen.under(set_ups.best.set_up.correction).frame() if undo and unfit else None
    if undo and frame:
        unfit, undo = f"{unfit}: {frame.what}", frame.beside(undo)
    show(_set_up_line(set_ups, unfit), *_log_lines(seen, set_ups, bool(unfit)))
    if out is not None:
        _write(undo, reading.columns, out)


def _unfit(seen: SeenRuns, set_ups: SetUpPosterior) -> str:
    """Return what else keeps the log from fitting; empty if nothing does.

    No run of it allows a verdict, or the sensor stands a little elsewhere.
    """
    fatal = [quality.fatal for quality in seen.evidence.quality]
    if all(fatal):
        return f"cannot tell, because {fatal[0]}"
    return seen.under(set_ups.best.set_up.correction).elsewhere() if set_ups.fits else ""


def _set_up_line(set_ups: SetUpPosterior, unfit: str) -> str:
    from failuretwin.inference.seen_runs import set_up_finding

    said = "; ".join(filter(None, (set_up_finding(set_ups), unfit)))
    return f"set-up: {said or 'the log fits the profile'}"


def _log_lines(seen: SeenRuns, set_ups: SetUpPosterior, unfit: bool) -> list[str]:
    """Return what the logs hold, and what is wrong with them.

    Of a log that does not fit it is not asked whether the calibration is of another robot.
    """
    from failuretwin.core.errors import counted
    from failuretwin.core.runs import measured_rate
    from failuretwin.inference.calibration_fit import calibration_told, fits_this_robot

    usable = seen.evidence.settled.usable
    lines = [
        f"log: {counted(len(usable), 'run')}, {counted(int(usable.sum()), 'movement')} after which "
        f"the tool is seen at rest, {measured_rate(seen.runs):.3g} readings a second"
    ]
    undone = seen.under(set_ups.best.set_up.correction)
    fits = fits_this_robot(undone) if set_ups.fits and not unfit else None
    if fits is not None:
        lines.insert(0, f"set-up: {calibration_told(undone.model.imperfections.name, fits)}")
    lines += [f"log: {line}" for line in undone.rounding()]
    names = [str(name) for name in seen.runs["run"].values]
    where: dict[str, list[str]] = {}
    for name, quality in zip(names, undone.evidence.quality, strict=True):
        for line in (*quality.remarks, *filter(None, [quality.fatal])):
            where.setdefault(line, []).append(name)
    found = sorted(where, key=lambda line: -len(where[line]))
    lines += [f"log: {line}{_in_runs(where[line], len(names))}" for line in found[:SHOWN]]
    if len(found) > SHOWN:
        lines.append(f"log: and {counted(len(found) - SHOWN, 'remark')} more")
    return lines if found else [*lines, "log: nothing is wrong with the readings"]


def _in_runs(named: Sequence[str], count: int) -> str:
    """Return in which of `count` runs something was found, as it stands behind a remark."""
    if count == 1:
        return ""
    if len(named) == count:
        return f" (all {count} runs)"
    more = f" and {len(named) - NAMED} more" if len(named) > NAMED else ""
    return f" ({', '.join(named[:NAMED])}{more})"


def _write(undo: SetUp | None, columns: Path | None, out: Path) -> None:
    """Write what undoes a wrong set-up, beside the column map that the log was read with."""
    from failuretwin.data_knowledge.store import write_text

    if undo is None or not undo.what:
        tell("nothing to put right, so nothing is written")
        return
    map_text = "" if columns is None else columns.read_text(encoding="utf-8").rstrip() + "\n\n"
    write_text(map_text + undo.correction.text(undo.what), out)
    tell(f"written to {out}: what undoes it; once you believe it, use it with --columns {out}")
