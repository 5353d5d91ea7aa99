"""`failuretwin check`, `design` and `isolability`: movements that are made to be told something."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from failuretwin.app.commands.options import (
    PATH,
    ArmOptions,
    SafetyOptions,
    arm_options,
    calibration_option,
    common_options,
    gathered,
    hypotheses_option,
    json_option,
    plugin_option,
    refuse_unused,
    report_option,
    safety_options,
)
from failuretwin.app.terminal import show, tell

if TYPE_CHECKING:
    from failuretwin.decision.test_motions.health_check import CheckResult
    from failuretwin.decision.test_motions.session import Checking
    from failuretwin.digital_model.robot import Robot


@dataclass(frozen=True)
class MotionOptions:
    """Values of `motion_options`: hypotheses and movements of a check."""

    hypotheses: str | None
    usual: bool = False
    rest: float = 0.0

    def checking(
        self, safety: SafetyOptions, calibration: Path | None, robot: str, seed: int
    ) -> Checking:
        """Return what a check and a design need."""
        from failuretwin.app.inputs import parse_cli_hypotheses
        from failuretwin.decision.test_motions.session import Checking
        from failuretwin.digital_model.calibrated_robot import load_calibration

        known = load_calibration(calibration, robot)
        named = parse_cli_hypotheses(self.hypotheses, known.robot)
        gate = safety.gate(known.robot)
        return Checking(known, gate, named, self.usual, seed, self.rest)


motion_options = gathered(
    MotionOptions,
    "motion",
    hypotheses_option("Hypotheses to consider. Default: every single fault that shows at rest."),
    click.option(
        "--usual",
        is_flag=True,
        help="Keep to the ranges of usual movements, not to the limits of the joints alone.",
    ),
    click.option(
        "--rest",
        type=click.FloatRange(0.0, 10.0),
        default=0.0,
        metavar="SECONDS",
        help="Leave so much time after each movement for the tool to come to rest. Default: what "
        "arms of this kind need. An arm that is commanded is waited for anyway.",
    ),
)
seconds_option = click.option(
    "--seconds",
    type=click.FloatRange(min=0.0, max=3600.0, min_open=True),
    default=20.0,
    help="Time for the movements.",
)


DESIGN = ("seconds", "usual", "rest")
"""Options that say how motions are designed."""
ARM = ("place", "faults", "move", "topics", "further")
"""Options that say which arm is moved, and how far."""
MOTIONS = ("written", "motions", "keep", "speed_share", "floor", "radius")
"""Options that say which motions are made, or where they go."""


@click.command()
@seconds_option
@click.option(
    "--write",
    "written",
    type=PATH,
    metavar="FILE",
    help="Move nothing: write the motions (.json, .csv, .mcap, .bag) for an arm that we cannot "
    "command.",
)
@click.option(
    "--log",
    "logs",
    multiple=True,
    type=PATH,
    metavar="INPUT",
    help="Move nothing: say what the log of a check says that was recorded elsewhere. Can be given "
    "several times.",
)
@click.option(
    "--motions",
    type=PATH,
    metavar="FILE",
    help="Make these motions (.json, .csv, .mcap, .bag, or what --keep wrote). Default: they are "
    "designed anew.",
)
@click.option(
    "--keep",
    type=PATH,
    metavar="FILE.json",
    help="Keep motions and results of this robot there; if it exists, make the same motions again "
    "(without --seconds) and say what has changed.",
)
@click.option(
    "--further",
    type=click.IntRange(min=0),
    default=0,
    help="Maximum number of further movements if the result is still open.",
)
@json_option("Write one object a line.")
@report_option("Write index.html: the state of the robot, which motor, how surely, what to do.")
@arm_options
@motion_options
@safety_options
@calibration_option
@plugin_option
@common_options
def check(
    seconds: float,
    written: Path | None,
    logs: tuple[Path, ...],
    motions: Path | None,
    keep: Path | None,
    further: int,
    json_file: Path | None,
    report: Path | None,
    arm: ArmOptions,
    motion: MotionOptions,
    safety: SafetyOptions,
    calibration: Path | None,
    robot: str,
    seed: int,
) -> None:
    """Move an arm for 20 or 60 s and say whether it is healthy, or which motor is not.

    Movements are chosen to tell most; each passes the gate of `act`. See docs/check.md.
    """
    from failuretwin.app.arms import commander_of, is_moved
    from failuretwin.app.reports import check_report as said
    from failuretwin.data_knowledge.store import write_records
    from failuretwin.decision.test_motions.motions import write_motions

    _refuse_what_does_nothing(logs, written, motions, keep)
    before = said.kept_checks(keep) if keep is not None and keep.exists() else []
    _check_outputs(keep, json_file, report)
    asking = motion.checking(safety, calibration, robot, seed)
    model = asking.known.robot
    if logs:
        _check_logs(asking.of_logs(logs), model, json_file, report)
        return
    planned = asking.motions(seconds, keep if before else motions)
    if written is not None:
        write_motions(planned, model, written)
        show(*said.motion_lines(planned, model), f"written to {written}; nothing was moved")
        return
    if not is_moved(arm):
        show("nothing moves without --move; these are the motions")
        show(*said.motion_lines(planned, model))
        return
    with ExitStack() as stack:
        commander = commander_of(arm, asking.known, seed, stack)
        result = asking.health_check(planned, further).work(commander, tell)
    time, command = planned.reference()
    result = asking.shown(result, command, time)
    record = said.check_record(result, model, planned.duration_s)
    show(*said.check_lines(result, model, planned.duration_s))
    if keep is not None:
        said.keep_check(keep, planned, [*before, record])
        show(*(said.changes(before[-1], record) if before else [f"kept in {keep}"]))
    if json_file is not None:
        write_records([record], json_file)
    if report is not None:
        said.write_check_page([result], model, report)
    show(*said.closing_lines(result, model))


def _refuse_what_does_nothing(
    logs: Sequence[Path], written: Path | None, motions: Path | None, keep: Path | None
) -> None:
    """Raise InputError if options were given that would do nothing beside these."""
    if logs:
        why = "with --log nothing is moved and nothing is kept"
        refuse_unused(why, *DESIGN, *ARM, *MOTIONS)
    if written is not None:
        refuse_unused("with --write nothing is moved", *ARM, "keep", "json_file", "report")
    if motions is not None:
        refuse_unused(f"{motions} says which motions are made", *DESIGN)
    if keep is not None and keep.exists():
        why = f"{keep} exists and says which motions are made; to make others, keep them elsewhere"
        refuse_unused(why, "motions", *DESIGN)


def _check_outputs(keep: Path | None, json_file: Path | None, report: Path | None) -> None:
    """Raise OutputError unless all that is to be written can be, before anything moves."""
    from failuretwin.data_knowledge.store import check_fillable, check_writable

    for path in (keep, json_file):
        if path is not None:
            check_writable(path)
    if report is not None:
        check_fillable(report)


def _check_logs(
    results: Sequence[CheckResult], model: Robot, json_file: Path | None, report: Path | None
) -> None:
    """Say what logs of checks say that were recorded elsewhere."""
    from failuretwin.app.reports import check_report as said
    from failuretwin.data_knowledge.store import write_records

    for result in results:
        lines = said.check_lines(result, model, 0.0)
        show(result.diagnosis.run, *lines, *said.closing_lines(result, model), "")
    if json_file is not None:
        write_records([said.check_record(r, model, 0.0) for r in results], json_file)
    if report is not None:
        said.write_check_page(results, model, report)


@click.command()
@seconds_option
@click.option(
    "--movements", type=click.IntRange(min=1), default=1000, help="Maximum number of movements."
)
@click.option(
    "--write", "written", type=PATH, metavar="FILE", help="Write .json, .csv, .mcap or .bag."
)
@motion_options
@safety_options
@calibration_option
@plugin_option
@common_options
def design(
    seconds: float,
    movements: int,
    written: Path | None,
    motion: MotionOptions,
    safety: SafetyOptions,
    calibration: Path | None,
    robot: str,
    seed: int,
) -> None:
    """Choose movements that tell most, and say which faults they show, beside random ones."""
    from failuretwin.app.reports.check_report import motion_lines
    from failuretwin.app.reports.isolability_report import compared_table
    from failuretwin.decision.test_motions.motions import write_motions

    asking = motion.checking(safety, calibration, robot, seed)
    model = asking.known.robot
    planned = asking.motions(seconds, None, movements)
    if written is not None:
        write_motions(planned, model, written)
    random = asking.random_motions(planned.duration_s, len(planned.orders))
    found = asking.isolability_of(planned), asking.isolability_of(random)
    show(*motion_lines(planned, model), compared_table(*found, model))


@click.command()
@click.option(
    "--motions",
    type=PATH,
    metavar="FILE",
    help="Motions that `design` or `check` wrote (.json, .csv, .mcap, .bag), or a log or run set. "
    "Default: the usual random movements.",
)
@hypotheses_option("Hypotheses to compare. Default: the paper's nine classes.")
@report_option("Draw the smallest sizes there, isolability.png.")
@json_option("Write the table.")
@calibration_option
@plugin_option
@common_options
def isolability(
    motions: Path | None,
    hypotheses: str | None,
    report: Path | None,
    json_file: Path | None,
    calibration: Path | None,
    robot: str,
    seed: int,
) -> None:
    """Say the smallest fault of each motor and mode that motions of a robot can show."""
    from failuretwin.app.reports import isolability_report as words
    from failuretwin.data_knowledge.store import write_records

    asking = MotionOptions(hypotheses).checking(SafetyOptions(), calibration, robot, seed)
    model = asking.known.robot
    found = (
        asking.isolability_of(asking.random_motions())
        if motions is None
        else asking.isolability_in(motions)
    )
    show(words.size_table(found, model), *words.group_lines(found, model))
    if json_file is not None:
        write_records(words.isolability_records(found), json_file)
    if report is not None:
        words.save_picture(found, model, report)
