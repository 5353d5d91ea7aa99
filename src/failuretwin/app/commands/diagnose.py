"""`failuretwin diagnose` and `demo`: fault diagnosis of recorded runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

import failuretwin as ft
from failuretwin.app.commands import options as opt
from failuretwin.app.terminal import progress_bar, show, tell
from failuretwin.core.errors import InputError, counted

if TYPE_CHECKING:
    import xarray as xr

    from failuretwin.connection.life_history import History
    from failuretwin.connection.self_calibration import SelfCalibration
    from failuretwin.connection.tracked_diagnosis import Tracked
    from failuretwin.inference.faults.priors import Priors


BAYES_ONLY = (
    *("calibration", "track", "self_calibrate", "hypotheses"),
    *("sse_range", "error_range", "onset", "sensing"),
)
"""Options that only the Bayesian diagnosis has."""
LEARNING = ("out", "independent")
"""Options that only learning from several runs has."""


@dataclass(frozen=True)
class Findings:
    """Diagnoses of runs, and what the runs taught together.

    Attributes:
        diagnoses: Diagnosis of each run.
        bayes: The Bayesian diagnoser, with the calibration learned from the runs.
        learned: Result of --self-calibrate; None: not asked for.
        tracked: Result of --track; None: not asked for.
    """

    diagnoses: Sequence[ft.Diagnosis]
    bayes: ft.BayesDiagnoser
    learned: SelfCalibration | None = None
    tracked: Tracked | None = None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on the robot learned by --self-calibrate."""
        return () if self.learned is None else self.learned.remarks

    @property
    def lines(self) -> list[str]:
        """Lines on everything learned."""
        from failuretwin.app.reports.calibration_report import tracking_line

        lines = [f"self-calibrated: {line}" for line in self.remarks]
        return lines if self.tracked is None else [*lines, tracking_line(self.tracked)]


@click.command()
@click.option(
    "--method",
    default="bayes",
    metavar="bayes|MODEL|bayes+MODEL|module:Class",
    help="Method of diagnosis: Bayes' rule, a network that `train` wrote, both, or your own class.",
)
@click.option(
    "--track",
    is_flag=True,
    help="Judge each run by what those before it teach of the robot, and go on learning. Give runs "
    "in their order, the oldest first. Without --calibration it begins with the arm class. The "
    "history is kept beside the calibration, or beside --out (FILE.history.jsonl).",
)
@click.option(
    "--self-calibrate",
    is_flag=True,
    help="Learn from all runs together, all of one robot, how it differs from others of its kind "
    "or from --calibration FILE. No healthy logs are needed.",
)
@click.option(
    "--independent",
    is_flag=True,
    help="With --track or --self-calibrate: faults of one run say nothing of the next, as in a set "
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
@opt.report_option(
    "Write index.html: the state of the robot, what to do, and pictures of some runs."
)
@opt.reading_options
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
    report: Path | None,
    reading: opt.LogOptions,
    robot: opt.RobotOptions,
) -> None:
    """Diagnose runs from commands and tool path alone, or what other sensors saw (--sensing).

    LOG is a run set (.nc, .zarr), a folder with raw sessions or published MATLAB files (searched
    downwards), such a file (.mat), a bag (.bag, .mcap), a LeRobot data set (a folder), an RTDE
    recording, or a CSV file, with --columns where its column names do not tell enough.
    """
    from failuretwin.app import inputs as given
    from failuretwin.app.reports import reports
    from failuretwin.app.reports.calibration_report import taught_section
    from failuretwin.app.reports.isolability_report import isolability_summary
    from failuretwin.app.reports.technician_page import write_report
    from failuretwin.decision.results import write_csv, write_json_lines
    from failuretwin.decision.robot_state import course_of, robot_state
    from failuretwin.inference.faults.priors import priors_of
    from failuretwin.inference.observation.sensors import TOOL_ALONE, sensing_of

    known, calibration = robot.known, robot.calibration
    bayes = ft.BayesDiagnoser(
        known.twin,
        imperfections=known.imperfections,
        hypotheses=given.parse_cli_hypotheses(hypotheses, known.robot),
        priors=priors_of(known.robot, sse_range, onset, error_range),
        sensing=sensing,
    )
    if method != given.BAYES:
        opt.refuse_unused("only the Bayesian diagnosis has these options", *BAYES_ONLY)
    diagnoser = given.chosen_diagnoser(method, bayes)
    together = track or self_calibrate
    _check_together(calibration, track, self_calibrate, out)
    history = _history(bayes, calibration, out) if track else None
    runs = reading.runs(known.robot)
    sensed = sensing_of(runs, sensing)
    given.warn_mismatch(runs, given.expected_name(diagnoser))
    found = (
        _learn(runs, bayes, sensed, history, calibration, out)
        if together
        else Findings(diagnoser.diagnose(runs), bayes)
    )
    diagnoses = given.with_doubts(found.diagnoses, runs, known.twin)
    if (sse_range or error_range) and diagnoser is bayes:
        usual = priors_of(known.robot, None, onset)
        _tell_ruled_out(runs, found.bayes, diagnoses, usual)
    course = course_of(diagnoses, found.bayes) if together and not independent else None
    state = robot_state(diagnoses, known.robot, course, found.remarks if together else None)
    if json_file is not None:
        write_json_lines(diagnoses, json_file, course)
    if csv_file is not None:
        write_csv(diagnoses, csv_file, course)
    if report is not None:
        sections = [taught_section(found.learned, known.robot)] if found.learned else []
        write_report(runs, diagnoses, known.twin, state, report, sections)
        tell(f"the page: {report / 'index.html'}", err=True)
    _keep(found.tracked, runs, out)
    show(*reports.diagnosis_parts(diagnoses))
    if method == given.BAYES and sensed == TOOL_ALONE:
        show(*isolability_summary(runs, found.bayes))
    show(*reports.state_lines(state, together=course is not None))
    show(*reports.score_parts(diagnoses))
    last = [*reports.course_lines(course, state, known.robot), *found.lines]
    show(*([""] if last else []), *last)


def _learn(
    runs: xr.Dataset,
    bayes: ft.BayesDiagnoser,
    sensed: tuple[str, ...],
    history: History | None,
    calibration: Path | None,
    out: Path | None,
) -> Findings:
    """Return diagnoses that learn the robot, run by run if there is a history, else from all runs.

    Raises:
        InputError: If the runs do not show the tool's position.
    """
    from failuretwin.inference.observation.sensors import TOOL_ALONE

    if sensed != TOOL_ALONE:
        raise InputError(
            f"the runs hold no tool position, but only what {' and '.join(sensed)} read. --track "
            "and --self-calibrate learn from the tool's position: leave them out, or give logs "
            "with one."
        )
    if history is None:
        return _self_calibrate(runs, bayes, calibration, out)
    return _track(runs, bayes, history)


def _track(runs: xr.Dataset, bayes: ft.BayesDiagnoser, history: History) -> Findings:
    """Return diagnoses that learn the robot run by run; `history` holds its earlier runs."""
    from failuretwin.connection.tracked_diagnosis import diagnose_tracked

    with progress_bar("diagnosing", runs.sizes["run"]) as advance:
        tracked = diagnose_tracked(runs, bayes, history, advance)
    return Findings(tracked.diagnoses, bayes, tracked=tracked)


def _self_calibrate(
    runs: xr.Dataset, bayes: ft.BayesDiagnoser, calibration: Path | None, out: Path | None
) -> Findings:
    """Return diagnoses that learn the robot from all runs at once, from a calibration on."""
    from failuretwin.connection.calibration.result import check_calibration_file
    from failuretwin.inference.together.folder_posterior import PASSES

    robot = bayes.twin.robot
    if out is not None:
        check_calibration_file(out)
    together = ft.SelfCalibratingDiagnoser(robot, calibration, bayes.hypotheses, bayes.priors)
    with progress_bar("self-calibrating", PASSES) as advance:
        learned = together.learn(runs, advance)
    if out is not None:
        ft.save_calibration(learned.calibration, robot, out)
    known = learned.calibration.imperfections
    calibrated = ft.BayesDiagnoser(together.twin, known, bayes.hypotheses, bayes.priors)
    return Findings(learned.diagnoses, calibrated, learned=learned)


def _tell_ruled_out(
    runs: xr.Dataset, bayes: ft.BayesDiagnoser, diagnoses: Sequence[ft.Diagnosis], usual: Priors
) -> None:
    """Report runs with errors of a size that the user has ruled out; `usual` priors allow all."""
    from failuretwin.inference.explanation import joint_names_in

    free = replace(bayes, priors=usual).diagnose(runs)
    others = [
        d
        for d, told in zip(free, diagnoses, strict=True)
        if str(d.diagnosis).endswith(":steady_state_error")
        and d.diagnosis != told.diagnosis
        and max(d.posterior.values()) > SURE
    ]
    if others:
        said = joint_names_in(others[0].verdict, bayes.twin.robot)
        tell(
            f"note: {counted(len(others), 'run')} would look otherwise without the range of errors "
            f"that was given, such as {others[0].run}: {said}",
            err=True,
        )


SURE = 0.9
"""Probability from which a run that would look otherwise is reported."""


def _check_together(
    calibration: Path | None, track: bool, all_runs: bool, out: Path | None
) -> None:
    """Raise InputError if ways of learning from runs contradict each other, or none is chosen."""
    if track and all_runs:
        raise InputError(
            "--track judges each run by those before it, --self-calibrate by all. Choose one."
        )
    if out is not None and track and _is_file(calibration):
        raise InputError(
            "--track keeps what it learns beside the calibration that it began with. Leave out "
            "--out, or --calibration to begin with the arm class."
        )
    if not (track or all_runs):
        opt.refuse_unused("nothing is learned without --track or --self-calibrate", *LEARNING)


def _is_file(calibration: Path | None) -> bool:
    """Return whether a calibration is a file, beside which a history may be kept."""
    from failuretwin.digital_model.calibrated_robot import GENERIC

    return calibration is not None and calibration != Path(GENERIC)


def _history(bayes: ft.BayesDiagnoser, calibration: Path | None, out: Path | None) -> History:
    """Return what has been seen of a robot before; nothing is kept where no file is named."""
    from failuretwin.connection.calibration.result import check_calibration_file
    from failuretwin.connection.life_history import History, open_history
    from failuretwin.connection.tracked_diagnosis import begin

    cold = not _is_file(calibration)
    start, beside = begin(bayes, cold), out if cold else calibration
    if out is not None:
        check_calibration_file(out)
    return History(start, cold) if beside is None else open_history(beside, start, cold)


def _keep(tracked: Tracked | None, runs: xr.Dataset, out: Path | None) -> None:
    """Keep what was learned of the runs; nothing was where they were not tracked."""
    from failuretwin.connection.life_history import keep_history
    from failuretwin.connection.tracked_diagnosis import calibration_of

    if tracked is None:
        return
    if out is not None:
        ft.save_calibration(calibration_of(tracked.life, runs), tracked.life.model.twin.robot, out)
    keep_history(tracked.history, tracked.life, tracked.rows)


@click.command()
@opt.report_option("Also write a page with pictures there (needs the extra `plots`).")
def demo(report: Path | None) -> None:
    """Diagnose three simulated runs that come with the package, as `diagnose LOG` would.

    One is healthy, one has a stuck motor, one a motor that misses its targets.
    """
    words = [str(ft.sample_log()), *([] if report is None else ["--report", str(report)])]
    tell(f"failuretwin diagnose {' '.join(words)}\n")
    diagnose.main(words, prog_name="failuretwin diagnose", standalone_mode=False)
