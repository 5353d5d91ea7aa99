"""Diagnoses that learn the robot from several runs: --track and --self-calibrate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from failuretwin.app.reports.calibration_report import taught_section, tracking_line
from failuretwin.app.reports.technician_page import Section
from failuretwin.app.terminal import progress_bar
from failuretwin.connection.calibration.result import check_calibration_file, save_calibration
from failuretwin.connection.life_history import History, keep_history, open_history
from failuretwin.connection.self_calibration import SelfCalibratingDiagnoser, learned_name
from failuretwin.connection.tracked_diagnosis import begin, calibration_of, diagnose_tracked
from failuretwin.core.errors import InputError, counted
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.digital_model.calibrated_robot import GENERIC
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.explanation import joint_names_in
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.observation.sensors import TOOL_ALONE
from failuretwin.inference.together.folder_posterior import PASSES

if TYPE_CHECKING:
    import xarray as xr

SURE = 0.9
"""Probability from which a run that would look otherwise is reported."""


@dataclass(frozen=True)
class Findings:
    """Diagnoses of runs, and the robot learned from them.

    Attributes:
        diagnoses: Diagnosis of each run.
        bayes: The Bayesian diagnoser, with the calibration learned from the runs.
        remarks: Remarks on the robot.
        lines: Lines on the learned robot.
        sections: The same as sections of a page.
        keep: Writes what was learned run by run.
    """

    diagnoses: Sequence[Diagnosis]
    bayes: BayesDiagnoser
    remarks: tuple[str, ...] = ()
    lines: Sequence[str] = ()
    sections: Sequence[Section] = ()
    keep: Callable[[], None] = lambda: None


def check_learning_from(sensed: Sequence[str]) -> None:
    """Raise InputError unless runs show the tool's position, from which the robot is learned."""
    if tuple(sensed) != TOOL_ALONE:
        raise InputError(
            f"the runs hold no tool position, but only what {' and '.join(sensed)} read. --track "
            "and --self-calibrate learn from the tool's position: leave them out, or give logs "
            "with one."
        )


def self_calibrated(
    runs: xr.Dataset, bayes: BayesDiagnoser, calibration: Path | None, out: Path | None
) -> Findings:
    """Return diagnoses that learn the robot from all runs at once; the calibration goes to `out`.

    Raises:
        InputError: If nothing can be learned.
        OutputError: If the calibration cannot be written.
    """
    robot = bayes.twin.robot
    if out is not None:
        begun = calibration is not None and calibration.resolve() == out.resolve()
        given = bayes.healthy_model.imperfections.name
        check_calibration_file(out, robot, given if begun else learned_name(robot))
    together = SelfCalibratingDiagnoser(robot, calibration, bayes.hypotheses, bayes.priors)
    with progress_bar("self-calibrating", PASSES) as advance:
        learned = together.learn(runs, advance)
    if out is not None:
        save_calibration(learned.calibration, robot, out)
    known = learned.calibration.imperfections
    return Findings(
        learned.diagnoses,
        BayesDiagnoser(together.twin, known, bayes.hypotheses, bayes.priors),
        learned.remarks,
        [f"self-calibrated: {line}" for line in learned.remarks],
        [taught_section(learned, robot)],
    )


def opened_history(bayes: BayesDiagnoser, calibration: Path | None, out: Path | None) -> History:
    """Return the history of a robot, beside its calibration, or beside `out` if it has none.

    Raises:
        InputError: If there are both, or the history cannot be read.
    """
    uncalibrated = calibration is None or calibration == Path(GENERIC)
    if out is not None and not uncalibrated:
        raise InputError(
            "--track keeps what it learns beside the calibration that it began with. Leave out "
            "--out, or --calibration to begin with the arm class."
        )
    if out is not None:
        robot = bayes.twin.robot
        check_calibration_file(out, robot, learned_name(robot))
    start, beside = begin(bayes, uncalibrated), out if uncalibrated else calibration
    if beside is None:
        return History(start, uncalibrated)
    return open_history(beside, start, uncalibrated)


def tracked(
    runs: xr.Dataset, bayes: BayesDiagnoser, history: History, out: Path | None
) -> Findings:
    """Return diagnoses that learn the robot run by run; `history` holds its earlier runs."""
    with progress_bar("diagnosing", runs.sizes["run"]) as advance:
        found = diagnose_tracked(runs, bayes, history, advance)

    def keep() -> None:
        if out is not None:
            save_calibration(calibration_of(found.life, runs), bayes.twin.robot, out)
        keep_history(found.history, found.life, found.rows)

    return Findings(found.diagnoses, bayes, lines=[tracking_line(found)], keep=keep)


def ruled_out_note(
    runs: xr.Dataset, bayes: BayesDiagnoser, diagnoses: Sequence[Diagnosis], usual: Priors
) -> str:
    """Return a note on runs with errors of a size that the user has ruled out, or an empty string.

    The `usual` priors allow all sizes.
    """
    free = replace(bayes, priors=usual).diagnose(runs)
    others = [
        d
        for d, told in zip(free, diagnoses, strict=True)
        if str(d.diagnosis).endswith(":steady_state_error")
        and max(d.posterior.values()) > SURE >= told.posterior[str(d.diagnosis)]
    ]
    if not others:
        return ""
    return (
        f"note: {counted(len(others), 'run')} would look otherwise without the range of errors "
        f"that was given, such as {others[0].run}: "
        f"{joint_names_in(others[0].verdict, bayes.twin.robot)}"
    )
