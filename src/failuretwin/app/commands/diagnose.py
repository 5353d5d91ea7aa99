"""`failuretwin diagnose` and `demo`: fault diagnosis of recorded runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

import failuretwin as ft
from failuretwin.app.commands import options as opt
from failuretwin.app.commands.store import (
    LEARNED,
    StoreOptions,
    learned_priors_option,
    recorded_option,
    store_options,
)
from failuretwin.app.terminal import show, tell
from failuretwin.core.errors import InputError

if TYPE_CHECKING:
    from failuretwin.data_knowledge.workers import Workforce
    from failuretwin.inference.together.fault_course import FaultCourse

BAYES_ONLY = (
    *("calibration", "track", "self_calibrate", "hypotheses", "learned_priors"),
    *("sse_range", "error_range", "onset", "sensing"),
)
"""Options that only the Bayesian diagnosis has."""
LEARNING = ("out", "independent")
"""Options that only learning from several runs has."""
WHOLE = (
    *("method", "track", "independent"),
    *("json_file", "csv_file", "report", "correct"),
)
"""Options that need all runs in memory."""


@click.command()
@click.option(
    "--method",
    default="bayes",
    metavar="bayes|MODEL|bayes+MODEL|module:Class",
    help="Method of diagnosis: Bayes' rule, a network that `train` wrote, both, or your own class.",
)
@opt.flag_option(
    "--track",
    "Learn the robot run by run: judge each by those before it. Give runs "
    "in their order, the oldest first. Without --calibration it begins with the arm class. The "
    "history is kept in the --store, else beside the calibration, or beside --out "
    "(FILE.history.jsonl).",
)
@opt.flag_option(
    "--self-calibrate",
    "Learn from all runs together, all of one robot, how it differs from others of its kind "
    "or from --calibration FILE. No healthy logs are needed.",
)
@opt.flag_option(
    "--independent",
    "With --track or --self-calibrate: faults of one run say nothing of the next, as in a set "
    "of experiments. Default: faults stay until repaired, and the runs, in their order, get one "
    "verdict in addition to their own.",
)
@opt.file_option(
    "--out",
    "FILE",
    "Calibration to write: learned by --self-calibrate, or by --track without --calibration.",
)
@opt.hypotheses_option(
    "Hypotheses to consider, at least two: healthy, MOTOR:MODE, two of these joined by '+', or "
    "unknown. Example: healthy,motor_2:stuck. Default: the paper's nine classes."
)
@click.option(
    "--sse-range",
    nargs=2,
    type=float,
    metavar="LOW HIGH",
    help="Known range of steady-state errors [servo units]. Default: several, weighed.",
)
@click.option(
    "--error-range",
    type=(float, float, str),
    metavar="LOW HIGH UNIT",
    help="The same in deg, rad, mm, m, counts or percent of what each motor turns through, such as "
    "0.1 2 deg.",
)
@click.option("--onset", type=float, metavar="SECONDS", help="Onset of stuck faults, where known.")
@click.option(
    "--sensing",
    metavar="SENSOR+...",
    help="Sensors to use: tool (its position), orientation, accelerometer, gyroscope, wire, "
    "encoders, or several joined by '+'. Default: tool where runs have it, else what they have.",
)
@opt.json_option("Write one object a run, one a line.")
@opt.file_option("--csv csv_file", "FILE", "Write a table, a row a run.")
@opt.file_option(
    "--parquet",
    "DIR",
    "Write a folder of parquet files, piece by piece: for more runs than memory holds. The same "
    "command goes on after an interruption. Prints a summary in place of a row a run.",
)
@opt.report_option(
    "Write index.html: the state of the robot, what to do, and pictures of some runs."
)
@opt.file_option(
    "--correct",
    "OUT",
    "Write a copy of one LeRobot data set in which the joint offsets that are found are taken out. "
    "An offset is a constant difference of readings from commands where a joint stands still, as "
    "by a zero that has moved. Only those joints of `observation.state` and its statistics "
    "change; `action` never does, nor does a stuck motor.",
)
@store_options
@learned_priors_option
@recorded_option
@opt.reading_options
@opt.workforce_options("results", "the logs and the folder of --parquet")
@opt.plugin_option
@opt.calibrated_robot_options()
def diagnose(
    method: str,
    track: bool,
    self_calibrate: bool,
    independent: bool,
    out: Path | None,
    hypotheses: str | None,
    sse_range: tuple[float, float] | None,
    error_range: tuple[float, float, str] | None,
    onset: float | None,
    sensing: str | None,
    json_file: Path | None,
    csv_file: Path | None,
    parquet: Path | None,
    report: Path | None,
    correct: Path | None,
    learned_priors: bool,
    recorded: datetime | None,
    memory: StoreOptions,
    reading: opt.LogOptions,
    workforce: Workforce,
    robot: opt.RobotOptions,
) -> None:
    """Diagnose runs from commands and tool path alone, or what other sensors saw (--sensing).

    LOG is a run set (.nc, .zarr), a folder with raw sessions or published MATLAB files (searched
    downwards), such a file (.mat), a bag (.bag, .mcap), a LeRobot data set (a folder), an RTDE
    recording, or a CSV file, with --columns where its column names do not tell enough.
    """
    from failuretwin.app import inputs as given
    from failuretwin.app import learning, offsets
    from failuretwin.app.many_runs import diagnose_many
    from failuretwin.app.reports import reports
    from failuretwin.app.reports.isolability_report import isolability_summary
    from failuretwin.app.reports.technician_page import write_report
    from failuretwin.decision.robot_state import course_of, robot_state
    from failuretwin.inference.faults.priors import priors_of
    from failuretwin.inference.observation.sensors import TOOL_ALONE, sensing_of

    offsets.check_correctable(reading.logs, correct)
    together = track or self_calibrate
    stored, known = memory.look_up(robot, learned_priors and not together)
    bayes = ft.BayesDiagnoser(
        known.twin,
        imperfections=known.imperfections,
        hypotheses=given.parse_cli_hypotheses(hypotheses, known.robot),
        priors=priors_of(known.robot, sse_range, onset, error_range),
        sensing=sensing,
    )
    _refuse_unused(method == given.BAYES, track, self_calibrate, parquet is not None)
    if learned_priors:
        taught = memory.needed(stored, LEARNED).learned_priors(bayes.hypothesis_set, bayes.priors)
        bayes = replace(bayes, priors=taught)
    start = learning.Start(robot.calibration, out, stored)
    if parquet is not None:
        show(
            *diagnose_many(
                reading,
                bayes,
                parquet,
                workforce,
                start if self_calibrate else None,
                stored,
                recorded,
            )
        )
        return
    keeper = None if stored is None else stored.keeper(reading, recorded)
    diagnoser = given.chosen_diagnoser(method, bayes)
    tracking = learning.Tracking(bayes, start) if track else None
    runs = (reading if keeper is None else keeper).runs(known.robot, workforce)
    sensed = sensing_of(runs, sensing)
    given.warn_mismatch(runs, given.expected_name(diagnoser))
    taught_by = tracking or (start if self_calibrate else None)
    found = learning.found_in(runs, bayes, diagnoser, taught_by, sensed)
    diagnoses = given.with_doubts(found.diagnoses, runs, known.twin, learned_priors)
    if (sse_range or error_range) and diagnoser is bayes:
        usual = priors_of(known.robot, None, onset)
        tell(learning.ruled_out_note(runs, found.bayes, diagnoses, usual), err=True)
    course = course_of(diagnoses, found.bayes) if together and not independent else None
    state = robot_state(diagnoses, known.robot, course, found.remarks if together else None)
    _write(diagnoses, course, json_file, csv_file)
    if report is not None:
        write_report(runs, diagnoses, known.twin, state, report, found.sections)
        tell(f"the page: {report / 'index.html'}", err=True)
    remembered = [] if keeper is None else ["", *keeper.remember(diagnoses)]
    found.keep(None if keeper is None else keeper.latest)
    show(*reports.diagnosis_parts(diagnoses))
    if method == given.BAYES and sensed == TOOL_ALONE:
        show(*isolability_summary(runs, found.bayes, robot.words))
    show(*reports.state_lines(state, together=course is not None))
    show(*reports.score_parts(diagnoses))
    last = [*reports.course_lines(course, state, known.robot), *found.lines]
    show(*([""] if last else []), *last)
    show(*offsets.offset_lines(runs, known, diagnoses, reading, correct))
    show(*remembered)


def _write(
    diagnoses: Sequence[ft.Diagnosis],
    course: FaultCourse | None,
    json_file: Path | None,
    csv_file: Path | None,
) -> None:
    """Write the diagnoses, with the fault course over all runs if there is one."""
    from failuretwin.decision.results import write_csv, write_json_lines

    if json_file is not None:
        write_json_lines(diagnoses, json_file, course)
    if csv_file is not None:
        write_csv(diagnoses, csv_file, course)


def _refuse_unused(bayes: bool, track: bool, self_calibrate: bool, parquet: bool) -> None:
    """Raise InputError if options contradict each other or have no effect."""
    if parquet:
        opt.refuse_unused("--parquet holds a piece of the runs in memory, not all", *WHOLE)
    if track and self_calibrate:
        raise InputError(
            "--track judges each run by those before it, --self-calibrate by all. Choose one."
        )
    if not bayes:
        opt.refuse_unused("only the Bayesian diagnosis has these options", *BAYES_ONLY)
    if not (track or self_calibrate):
        opt.refuse_unused("nothing is learned without --track or --self-calibrate", *LEARNING)


@click.command()
@opt.report_option("Also write a page with pictures there (needs the extra `plots`).")
def demo(report: Path | None) -> None:
    """Diagnose three simulated runs that come with the package, as `diagnose LOG` would.

    One is healthy, one has a stuck motor, one a motor that misses its targets.
    """
    words = [str(ft.sample_log()), *([] if report is None else ["--report", str(report)])]
    tell(f"failuretwin diagnose {' '.join(words)}\n")
    diagnose.main(words, prog_name="failuretwin diagnose", standalone_mode=False)
