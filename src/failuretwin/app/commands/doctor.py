"""`failuretwin doctor`: whether a log fits the profile of its robot, before anyone diagnoses it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

import failuretwin as ft
from failuretwin.app.commands import options as opt
from failuretwin.app.terminal import elapsed, show, tell
from failuretwin.core.errors import InputError, counted

if TYPE_CHECKING:
    from failuretwin.inference.seen_runs import SeenRuns
    from failuretwin.inference.set_up_posterior import SetUpPosterior
    from failuretwin.inference.set_ups.set_ups import SetUp

SHOWN = 5
"""Maximum number of different remarks that are listed."""
TRAILS_S = 0.1
"""By so much more than usual clocks that are apart show on the way [s]."""
NAMED = 3
"""Maximum number of runs that are named after a remark."""


@click.command()
@opt.file_option(
    "--out",
    "MAP.toml",
    "Column map to write, with the correction of a wrong set-up. If you agree with it, use it "
    "with --columns MAP.toml.",
)
@opt.reading_options
@opt.calibrated_robot_options()
def doctor(
    out: Path | None,
    reading: opt.LogOptions,
    robot: opt.RobotOptions,
) -> None:
    """Test whether logs fit the profile: senses, order, units, axes, zeros, frames, clocks, grids.

    LOG is any input of `diagnose`, faulty or not; all logs must share one set-up. Every mistake is
    weighed together with every fault, so that a broken motor is not taken for a wrong set-up.
    """
    if out is not None and (out.suffix != ".toml" or out.exists()):
        raise InputError(f"{out}: expected a name that ends in .toml and is not taken yet.")
    known = robot.known
    runs = reading.runs(robot.model)
    seen = ft.BayesDiagnoser(known.twin, known.imperfections).seen(runs)
    with elapsed("looking at set-ups"):
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
    """Return any other reason why the log does not fit; empty if there is none.

    Either no run allows a verdict, or the sensor is slightly displaced.
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
    """Return the contents of the logs and the remarks on them.

    The calibration is only compared with logs that fit the profile.
    """
    from failuretwin.core.runs import measured_rate
    from failuretwin.inference.calibration_fit import calibration_told, fits_this_robot

    usable = seen.evidence.settled.usable
    way = seen.settled.moments_on_the_way
    on_way = f", {counted(way, 'moment')} on its way" if way else ""
    lines = [
        f"log: {counted(len(usable), 'run')}, {counted(int(usable.sum()), 'movement')} after which "
        f"the tool is seen at rest{on_way}, "
        f"{measured_rate(seen.runs):.3g} readings a second"
    ]
    undone = seen.under(set_ups.best.set_up.correction)
    fits = fits_this_robot(undone) if set_ups.fits and not unfit else None
    if fits is not None:
        lines.insert(0, f"set-up: {calibration_told(undone.model.imperfections.name, fits)}")
    if way and abs(undone.lag_s - undone.model.lag_s) > TRAILS_S:
        lines.insert(0, f"set-up: {_trailing(undone.lag_s, undone.model.lag_s)}")
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


def _trailing(lag_s: float, usual_s: float) -> str:
    """Return that the tool trails its commands more or less than usual on its way."""
    sense = "trails its commands by" if lag_s >= 0.0 else "is ahead of its commands by"
    return (
        f"on its way the tool {sense} {abs(lag_s):.2f} s (usual: {usual_s:.2f} s): the clocks of "
        "commands and readings are apart, or every motor is late; allowed for"
    )


def _in_runs(named: Sequence[str], count: int) -> str:
    """Return the runs of a remark in brackets; `count` is the number of all runs."""
    if count == 1:
        return ""
    if len(named) == count:
        return f" (all {count} runs)"
    more = f" and {len(named) - NAMED} more" if len(named) > NAMED else ""
    return f" ({', '.join(named[:NAMED])}{more})"


def _write(undo: SetUp | None, columns: Path | None, out: Path) -> None:
    """Write the correction of a wrong set-up, after the column map that the log was read with."""
    from failuretwin.data_knowledge.store import write_text

    if undo is None or not undo.what:
        tell("nothing to put right, so nothing is written")
        return
    map_text = "" if columns is None else columns.read_text(encoding="utf-8").rstrip() + "\n\n"
    write_text(map_text + undo.correction.text(undo.what), out)
    tell(f"written to {out}: what undoes it; once you believe it, use it with --columns {out}")
