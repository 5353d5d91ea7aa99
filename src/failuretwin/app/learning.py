"""Diagnoses that learn the robot from several runs: --track and --self-calibrate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from failuretwin.app.reports.calibration_report import taught_section, tracking_line
from failuretwin.app.reports.technician_page import Section
from failuretwin.app.terminal import progress_bar
from failuretwin.connection.calibration.result import check_calibration_file, save_calibration
from failuretwin.connection.self_calibration import SelfCalibratingDiagnoser, learned_name
from failuretwin.connection.tracked_diagnosis import (
    History,
    Tracked,
    begin,
    calibration_of,
    diagnose_tracked,
    keep_history,
    open_history,
)
from failuretwin.core.errors import InputError, counted
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.digital_model.calibrated_robot import GENERIC, CalibratedRobot, HealthyLike
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.diagnoser import BayesDiagnoser, Diagnoser
from failuretwin.inference.explanation import joint_names_in
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.observation.sensors import TOOL_ALONE
from failuretwin.inference.together.folder_posterior import PASSES

if TYPE_CHECKING:
    import xarray as xr

    from failuretwin.app.life_keeper import LifeKeeper
    from failuretwin.app.remembering import RobotRecord

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
        keep: Writes what was learned run by run, given when the last was (UTC; None: now).
    """

    diagnoses: Sequence[Diagnosis]
    bayes: BayesDiagnoser
    remarks: tuple[str, ...] = ()
    lines: Sequence[str] = ()
    sections: Sequence[Section] = ()
    keep: Callable[[datetime | None], None] = lambda at: None


def check_learning_from(sensed: Sequence[str]) -> None:
    """Raise InputError unless runs show the tool's position, from which the robot is learned."""
    if tuple(sensed) != TOOL_ALONE:
        raise InputError(
            f"the runs hold no tool position, but only what {' and '.join(sensed)} read. --track "
            "and --self-calibrate learn from the tool's position: leave them out, or give logs "
            "with one."
        )


@dataclass(frozen=True)
class Start:
    """What learning begins with, and where its result goes.

    Attributes:
        calibration: Calibration that is named; None: none is.
        out: Calibration to write; None: none.
        stored: The robot in the store, maybe with a calibration; None: there is no store.
    """

    calibration: Path | None
    out: Path | None
    stored: RobotRecord | None

    @property
    def cold(self) -> bool:
        """Whether nothing is known of this robot but its kind."""
        return self._of_store is None and self.calibration in (None, Path(GENERIC))

    @property
    def figures(self) -> HealthyLike:
        """The calibration; None: what arms of its class are like."""
        return self.calibration if self._of_store is None else self._of_store.imperfections

    @property
    def _of_store(self) -> CalibratedRobot | None:
        return None if self.stored is None else self.stored.calibrated


def found_in(
    runs: xr.Dataset,
    bayes: BayesDiagnoser,
    diagnoser: Diagnoser,
    tracking: Tracking | None,
    start: Start | None,
) -> Findings:
    """Return diagnoses of runs.

    Args:
        runs: The runs.
        bayes: The Bayesian diagnoser.
        diagnoser: What diagnoses runs that teach nothing.
        tracking: What learns run by run; None: nothing does.
        start: What learning from all runs at once begins with; None: nothing learns so.
    """
    if tracking is not None:
        return tracking.diagnose(runs)
    if start is not None:
        return self_calibrated(runs, bayes, start)
    return Findings(diagnoser.diagnose(runs), bayes)


def self_calibrated(runs: xr.Dataset, bayes: BayesDiagnoser, start: Start) -> Findings:
    """Return diagnoses that learn the robot from all runs at once.

    Raises:
        InputError: If nothing can be learned.
        OutputError: If the calibration cannot be written.
    """
    robot, out, calibration = bayes.twin.robot, start.out, start.calibration
    if out is not None:
        begun = calibration is not None and calibration.resolve() == out.resolve()
        given = bayes.healthy_model.imperfections.name
        check_calibration_file(out, robot, given if begun else learned_name(robot))
    together = SelfCalibratingDiagnoser(robot, start.figures, bayes.hypotheses, bayes.priors)
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


class Tracking:
    """Diagnosis run by run, which goes on from the history of a robot.

    The history lies in the store, beside the calibration, or beside `start.out`.

    Args:
        bayes: How to diagnose.
        start: What it begins with.

    Raises:
        InputError: If there are two places for the history, or it cannot be read.
    """

    def __init__(self, bayes: BayesDiagnoser, start: Start) -> None:
        self._bayes = bayes
        self._out = start.out
        stored = start.stored
        self._keeper = None if stored is None else _keeper_of(stored)
        if start.out is not None:
            _check_out(start, bayes.twin.robot)
        self._history = self._opened(start)

    def _opened(self, start: Start) -> History:
        begun = begin(self._bayes, start.cold)
        if self._keeper is not None:
            return self._keeper.history(begun, start.cold)
        beside = start.out if start.cold else start.calibration
        if beside is None:
            return History(begun, start.cold)
        return open_history(beside, begun, start.cold)

    def diagnose(self, runs: xr.Dataset) -> Findings:
        """Return diagnoses of runs, each by those before it."""
        with progress_bar("diagnosing", runs.sizes["run"]) as advance:
            found = diagnose_tracked(runs, self._bayes, self._history, advance)
        keep = partial(self._keep, runs, found)
        return Findings(found.diagnoses, self._bayes, lines=[tracking_line(found)], keep=keep)

    def _keep(self, runs: xr.Dataset, found: Tracked, at: datetime | None) -> None:
        if self._out is not None:
            save_calibration(calibration_of(found.life, runs), self._bayes.twin.robot, self._out)
        if self._keeper is not None:
            self._keeper.keep(found.life, found.rows, at)
        else:
            keep_history(found.history, found.life, found.rows)


def _keeper_of(stored: RobotRecord) -> LifeKeeper:
    from failuretwin.app.life_keeper import LifeKeeper  # needs the extra `store`

    return LifeKeeper(stored, "diagnose")


def _check_out(start: Start, robot: Robot) -> None:
    """Raise InputError unless `start.out` is the one place for what is learned."""
    if not start.cold:
        raise InputError(
            "--track keeps what it learns beside the calibration that it began with. Leave out "
            "--out, or --calibration to begin with the arm class."
        )
    if start.out is not None:
        check_calibration_file(start.out, robot, learned_name(robot))


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
