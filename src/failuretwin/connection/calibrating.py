"""The whole of a calibration: learn, suspect, learn again from what is trusted, and check."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.connection.calibration.calibrate import MOST_SUSPECT, SUSPECT, calibrate
from failuretwin.connection.calibration.observations import session_names
from failuretwin.connection.calibration.result import Calibration, LeftOut
from failuretwin.core.errors import InputError
from failuretwin.core.runs import check_motors, truth_of
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot, shown_unit
from failuretwin.inference.isolability import fault_probability

if TYPE_CHECKING:
    import xarray as xr

MOST_LEFT_OUT = 0.3
"""Share of movements that may be left out before the logs are refused."""

MOST_SCATTER_RAD = 0.03
"""Settled scatter beyond which a motor is no healthy one [rad], three times what is assumed of a
robot of which nothing is known: errors redrawn for every movement pass for scatter."""


def learn_robot(
    runs: xr.Dataset, robot: Robot, name: str, source: str, hold_out: str | None
) -> tuple[Calibration, xr.Dataset]:
    """Calibrate a robot from logs that should be healthy.

    Args:
        runs: The logs.
        robot: The robot.
        name: What to call the calibration in results.
        source: Which logs these are.
        hold_out: Text in the names of sessions that are not learned from, only judged; None: all
            sessions are learned from, and each is judged by a fit to the others.

    Returns:
        The calibration and the runs that it was learned from or judged on.

    Raises:
        InputError: If the logs are labelled faulty or look so, or too few movements are left.
    """
    check_motors(runs, robot.name, robot.motor_names)
    runs, labelled = _without_faulty_labels(runs)
    inside = _held_out_runs(runs, hold_out)
    learning = runs.isel(run=np.flatnonzero(~inside))
    first = calibrate(learning, robot, name, source, thorough=False)
    _refuse_scatter(first, robot)
    doubt = fault_probability(learning, robot, first.imperfections)
    _refuse_suspects(learning, doubt)
    judged = runs.isel(run=np.flatnonzero(inside)) if inside.any() else None
    found = calibrate(learning, robot, name, source, fault_probability=doubt, judged=judged)
    _refuse_left_out(found)
    return replace(found, left_out=(*labelled, *found.left_out)), runs


def _without_faulty_labels(runs: xr.Dataset) -> tuple[xr.Dataset, tuple[LeftOut, ...]]:
    truth = truth_of(runs)
    if truth is None:
        return runs, ()
    healthy = np.array([fault == "healthy" for fault in truth])
    if not healthy.any():
        raise InputError(
            "every run is labelled faulty. Expected healthy logs: a twin that learns from a fault "
            "takes it for normal."
        )
    names = runs["run"].values
    labelled = tuple(
        LeftOut(str(names[i]), 0, "", f"labelled {truth[i]}") for i in np.flatnonzero(~healthy)
    )
    return runs.isel(run=np.flatnonzero(healthy)), labelled


def _held_out_runs(runs: xr.Dataset, hold_out: str | None) -> np.ndarray:
    sessions = session_names(runs)
    inside = np.array([hold_out is not None and hold_out in session for session in sessions])
    known = ", ".join(dict.fromkeys(sessions))
    if hold_out is not None and not inside.any():
        raise InputError(f"--hold-out {hold_out!r} is in no session's name. There are: {known}.")
    if inside.all():
        raise InputError(f"--hold-out {hold_out!r} leaves nothing to learn from: {known}.")
    return inside


def _refuse_scatter(first: Calibration, robot: Robot) -> None:
    for parameter in first.parameters:
        if parameter.name == "scatter" and parameter.low > MOST_SCATTER_RAD:
            scale, unit = shown_unit("rad", robot)
            raise InputError(
                f"{parameter.motor} settles anew with every movement, with a scatter of "
                f"{scale * parameter.value:.1f} {unit}; expected {scale * MOST_SCATTER_RAD:.1f} at "
                "most. Nothing is learned from these logs; give logs of a healthy robot."
            )


def _refuse_suspects(runs: xr.Dataset, doubt: FloatArray) -> None:
    suspects = np.flatnonzero(doubt >= SUSPECT)
    if len(suspects) > MOST_SUSPECT * len(doubt):
        names = [str(runs["run"].values[i]) for i in suspects[:5]]
        raise InputError(
            f"{len(suspects)} of {len(doubt)} runs look faulty ({', '.join(names)}"
            f"{', ...' if len(suspects) > 5 else ''}), so nothing is learned from these logs. Give "
            "logs of a healthy robot; `failuretwin diagnose` shows what is wrong with each run."
        )


def _refuse_left_out(found: Calibration) -> None:
    movements = [entry for entry in found.left_out if entry.movement > 0]
    if len(movements) > MOST_LEFT_OUT * max(found.movements, 1):
        reasons = Counter(f"{e.motor} {e.reason}".strip() for e in movements).most_common(3)
        told = "; ".join(f"{reason} ({count} times)" for reason, count in reasons)
        raise InputError(
            f"{len(movements)} movements do not look healthy beside {found.movements} that do: "
            f"{told}. Nothing is learned from these logs; give logs of a healthy robot."
        )
