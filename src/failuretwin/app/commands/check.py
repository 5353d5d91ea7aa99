"""`failuretwin check`, `design` and `isolability`: test movements and the faults that they show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from failuretwin.app.commands import options as opt
from failuretwin.app.commands.store import StoreOptions, recorded_option, store_options
from failuretwin.app.terminal import progress_bar, show, tell, write_json
from failuretwin.core.progress import Progress

if TYPE_CHECKING:
    from failuretwin.app.remembering import RobotRecord
    from failuretwin.decision.test_motions.health_check import Checking
    from failuretwin.digital_model.calibrated_robot import CalibratedRobot


@dataclass(frozen=True)
class MotionOptions:
    """Values of `motion_options`: hypotheses and movements of a check."""

    hypotheses: str | None
    seconds: float = 20.0
    usual: bool = False
    rest: float = 0.0

    def checking(self, safety: opt.SafetyOptions, known: CalibratedRobot, seed: int) -> Checking:
        """Return the settings of a check or a design."""
        from failuretwin.app.inputs import parse_cli_hypotheses
        from failuretwin.decision.test_motions.health_check import Checking

        named = parse_cli_hypotheses(self.hypotheses, known.robot)
        return Checking(known, safety.gate(known.robot), named, self.usual, seed, self.rest)


motion_options = opt.gathered(
    MotionOptions,
    "motion",
    click.option(
        "--seconds",
        type=click.FloatRange(min=0.0, max=3600.0, min_open=True),
        default=20.0,
        metavar="SECONDS",
        help="Time for the movements.",
    ),
    opt.hypotheses_option(
        "Hypotheses to consider. Default: every single fault that shows at rest."
    ),
    opt.flag_option(
        "--usual", "Keep to the ranges of usual movements. Default: to the limits of the joints."
    ),
    click.option(
        "--rest",
        type=click.FloatRange(0.0, 10.0),
        default=0.0,
        metavar="SECONDS",
        help="Minimum time at rest after each movement. Default: by the kind of arm. A "
        "commanded arm is always waited for.",
    ),
)
write_option = opt.file_option(
    "--write written",
    "FILE",
    "Write the motions (.json, .csv, .mcap, .bag) for an arm that failuretwin cannot command. "
    "Nothing moves.",
)

DESIGN = ("seconds", "usual", "rest")
"""Options of the design of motions."""
ARM = (*opt.names_of(opt.ArmOptions), "further")
"""Options of the arm that is moved."""
MOTIONS = ("written", "motions", "keep", *opt.names_of(opt.SafetyOptions))
"""Options of the motions that are made."""


@click.command()
@write_option
@opt.file_option(
    "--log logs",
    "INPUT",
    "Judge the log of a check that was recorded elsewhere. Nothing moves. Can be given "
    "several times.",
    multiple=True,
)
@opt.file_option(
    "--motions",
    "FILE",
    "Make these motions (.json, .csv, .mcap, .bag, or a file of --keep). Default: they are "
    "designed anew.",
)
@opt.file_option(
    "--keep",
    "FILE.json",
    "File for motions and results of this robot. If it exists, the same motions are made "
    "again (without --seconds) and changes are reported.",
)
@opt.count_option(
    "--further", 0, "Maximum number of further movements if the result is still open."
)
@opt.output_options(
    "Write one object a line.",
    "Write index.html: the state of the robot, which motor, how surely, what to do.",
)
@opt.arm_options
@motion_options
@opt.safety_options
@store_options
@recorded_option
@opt.plugin_option
@opt.calibrated_robot_options()
def check(
    written: Path | None,
    logs: tuple[Path, ...],
    motions: Path | None,
    keep: Path | None,
    further: int,
    output: opt.OutputOptions,
    arm: opt.ArmOptions,
    motion: MotionOptions,
    safety: opt.SafetyOptions,
    memory: StoreOptions,
    recorded: datetime | None,
    robot: opt.RobotOptions,
) -> None:
    """Move an arm for 20 or 60 s and report whether it is healthy, or which motor is not.

    The movements are chosen to tell the most; each passes the gate of `act`. See docs/check.md.
    """
    from failuretwin.app.arms import commander_of, is_moved
    from failuretwin.app.reports import check_report as reports

    _refuse_unused(logs, written, motions, keep)
    before = reports.kept_checks(keep) if keep is not None and keep.exists() else []
    output.check(keep)
    stored, known = memory.look_up(robot)
    checking = motion.checking(safety, known, robot.seed)
    model = checking.known.robot
    if logs:
        _report_logs(logs, checking, output, stored, recorded)
        return
    opt.refuse_unused("only logs were recorded before", "recorded")
    planned = checking.motions(motion.seconds, keep if before else motions)
    if written is not None or not is_moved(arm):
        if written is None:
            show("nothing moves without --move; these are the motions")
        show(*reports.motion_lines(planned, model, written))
        return
    with ExitStack() as stack:
        commander = commander_of(arm, checking.known, robot.seed, stack)
        result = checking.carry_out(planned, further, commander, tell)
    time, command = planned.reference()
    with _smallest_faults(checking) as advance:
        result = checking.shown(result, command, time, advance)
    record = reports.check_record(result, model, planned.duration_s)
    show(*reports.check_lines(result, model, planned.duration_s))
    if keep is not None:
        reports.keep_check(keep, planned, [*before, record])
        show(*(reports.changes(before[-1], record) if before else [f"kept in {keep}"]))
    write_json([record], output.json_file)
    if output.report is not None:
        reports.write_check_page([result], model, output.report)
    show(*reports.closing_lines(result, model))
    if stored is not None:
        show("", *stored.remember_check([result]))


def _smallest_faults(checking: Checking, sets: int = 1) -> AbstractContextManager[Progress]:
    """Give what is told of the progress of the smallest faults that sets of motions show."""
    return progress_bar("smallest faults", sets * sum(bool(h.faults) for h in checking.asked))


def _refuse_unused(
    logs: Sequence[Path], written: Path | None, motions: Path | None, keep: Path | None
) -> None:
    """Raise InputError if options were given that have no effect beside these."""
    if logs:
        why = "with --log nothing is moved and nothing is kept"
        opt.refuse_unused(why, *DESIGN, *ARM, *MOTIONS)
    if written is not None:
        opt.refuse_unused("with --write nothing is moved", *ARM, "keep", "json_file", "report")
    if motions is not None:
        opt.refuse_unused(f"{motions} says which motions are made", *DESIGN)
    if keep is not None and keep.exists():
        why = f"{keep} exists and says which motions are made; to make others, keep them elsewhere"
        opt.refuse_unused(why, "motions", *DESIGN)


def _report_logs(
    logs: Sequence[Path],
    checking: Checking,
    output: opt.OutputOptions,
    stored: RobotRecord | None,
    recorded: datetime | None,
) -> None:
    """Report the results of checks that were recorded elsewhere, and store them."""
    from failuretwin.app.reports import check_report as reports

    model, results = checking.known.robot, checking.of_logs(logs)
    for result in results:
        lines = reports.check_lines(result, model, 0.0)
        show(result.diagnosis.run, *lines, *reports.closing_lines(result, model), "")
    write_json([reports.check_record(r, model, 0.0) for r in results], output.json_file)
    if output.report is not None:
        reports.write_check_page(results, model, output.report)
    if stored is not None:
        show(*_remembered(logs, checking, stored, recorded))


def _remembered(
    logs: Sequence[Path], checking: Checking, stored: RobotRecord, recorded: datetime | None
) -> Iterator[str]:
    """Store the checks of each log, and yield what was stored, in lines."""
    from failuretwin.data_knowledge.records.log_files import log_file

    for log in logs:
        yield from stored.remember_check(checking.of_logs([log]), log_file(log, recorded))


@click.command()
@opt.count_option("--movements", 1000, "Maximum number of movements.", least=1)
@write_option
@motion_options
@opt.safety_options
@opt.plugin_option
@opt.calibrated_robot_options()
def design(
    movements: int,
    written: Path | None,
    motion: MotionOptions,
    safety: opt.SafetyOptions,
    robot: opt.RobotOptions,
) -> None:
    """Design movements that tell the most, and compare the faults that they and random ones show.

    `failuretwin check --motions FILE` makes them.
    """
    from failuretwin.app.reports.check_report import motion_lines
    from failuretwin.app.reports.isolability_report import compared_table

    checking = motion.checking(safety, robot.known, robot.seed)
    planned = checking.motions(motion.seconds, None, movements)
    lines = motion_lines(planned, checking.known.robot, written)
    random = checking.random_motions(planned.duration_s, len(planned.orders))
    with _smallest_faults(checking, 2) as advance:
        designed = checking.isolability_of(planned, advance)
        drawn = checking.isolability_of(random, advance)
    show(*lines, compared_table(designed, drawn, checking.known.robot))


@click.command()
@opt.file_option(
    "--motions",
    "FILE",
    "Motions that `design` or `check` wrote (.json, .csv, .mcap, .bag), or a log or run set. "
    "Default: the usual random movements.",
)
@opt.hypotheses_option("Hypotheses to compare. Default: the paper's nine classes.")
@opt.output_options("Write the table.", "Draw the smallest sizes there, isolability.png.")
@opt.plugin_option
@opt.calibrated_robot_options()
def isolability(
    motions: Path | None,
    hypotheses: str | None,
    output: opt.OutputOptions,
    robot: opt.RobotOptions,
) -> None:
    """Report the smallest fault of each motor and mode that motions of a robot can show."""
    from failuretwin.app.reports import isolability_report as reports

    output.check()
    motion = MotionOptions(hypotheses)
    checking = motion.checking(opt.SafetyOptions(), robot.known, robot.seed)
    model = checking.known.robot
    with _smallest_faults(checking) as advance:
        found = (
            checking.isolability_of(checking.random_motions(), advance)
            if motions is None
            else checking.isolability_in(motions, advance)
        )
    remarks = [*reports.onset_lines(found), *reports.group_lines(found, model)]
    show(reports.size_table(found, model), *remarks)
    write_json(reports.isolability_records(found), output.json_file)
    if output.report is not None:
        reports.save_picture(found, model, output.report)
