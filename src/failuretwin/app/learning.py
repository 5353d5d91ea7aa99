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
from failuretwin.app.terminal import elapsed, progress_bar
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

    from failuretwin.app.keepers import LifeKeeper
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
    learns: Tracking | Start | None,
    sensed: Sequence[str],
) -> Findings:
    """Return diagnoses of runs by what sensors saw.

    A `Tracking` learns run by run, a `Start` begins to learn from all runs at once.

    Raises:
        InputError: If the robot cannot be learned from what was seen.
    """
    if learns is None:
        with elapsed("diagnosing"):
            return Findings(diagnoser.diagnose(runs), bayes)
    check_learning_from(sensed)
    if isinstance(learns, Tracking):
        return learns.diagnose(runs)
    return self_calibrated(runs, bayes, learns)


def self_calibrated(runs: xr.Dataset, bayes: BayesDiagnoser, start: Start) -> Findings:
    """Return diagnoses that learn the robot from all runs at once."""
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
    """

    def __init__(self, bayes: BayesDiagnoser, start: Start) -> None:
        self._bayes, self._out = bayes, start.out
        if start.out is not None:
            _check_out(start.out, start.cold, bayes.twin.robot)
        begun = begin(bayes, start.cold)
        self._keeper: LifeKeeper | None = None
        beside = start.out if start.cold else start.calibration
        if start.stored is not None:
            from failuretwin.app.keepers import LifeKeeper  # needs the extra `store`

            self._keeper = LifeKeeper(start.stored, "diagnose")
            self._history = self._keeper.history(begun, start.cold)
        elif beside is not None:
            self._history = open_history(beside, begun, start.cold)
        else:
            self._history = History(begun, start.cold)

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


def _check_out(out: Path, cold: bool, robot: Robot) -> None:
    """Raise InputError unless `out` is the one place for what is learned."""
    if not cold:
        raise InputError(
            "--track keeps what it learns beside the calibration that it began with. Leave out "
            "--out, or --calibration to begin with the arm class."
        )
    check_calibration_file(out, robot, learned_name(robot))


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
