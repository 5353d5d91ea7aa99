"""Robot behaviour learned from runs by `diagnose --self-calibrate` and `--track`."""

from __future__ import annotations

import numpy as np

from failuretwin.app.reports.calibration_report import parameter_table
from failuretwin.app.reports.tables import figures_table
from failuretwin.app.reports.technician_page import Section
from failuretwin.connection.self_calibration import SelfCalibration
from failuretwin.connection.tracked_diagnosis import Tracked
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.explanation import joint_names_in
from failuretwin.inference.together.wear_limits import wear_unit


def taught_section(learned: SelfCalibration, robot: Robot) -> Section:
    """Return what was learned, how far it lies from such robots, what each run taught of it.

    Args:
        learned: What some runs say together.
        robot: The robot.
    """
    found = learned.calibration
    by_run = [
        (diagnosis.run, f"{nats:.2f}")
        for diagnosis, nats in zip(learned.diagnoses, learned.taught, strict=True)
    ]
    return Section(
        "What the runs taught of the robot",
        [joint_names_in(line, robot) for line in found.remarks],
        [parameter_table(found.parameters, robot)],
        {"What each run taught": figures_table(("run", "taught [nats]"), by_run)},
    )


def tracking_line(tracked: Tracked) -> str:
    """Return what was learned of the runs, in one line."""
    life, history = tracked.life, tracked.history
    parts = [f"{len(tracked.rows)} runs learned", f"{life.arrived} in all"]
    if tracked.known:
        parts.append(f"{tracked.known} known already")
    told = f"tracked: {', '.join(parts)}; {_largest_changes(tracked)}"
    if life.alarm:
        told += f"; learning is stopped: {life.alarm}"
    if tracked.mixed:
        told += f"; {tracked.mixed}"
    return told if history.path is None else f"{told}; history: {history.path}"


def _largest_changes(tracked: Tracked) -> str:
    """Return the largest changes of bias and of sag, with their deviations."""
    life = tracked.life
    unit = wear_unit(life.model).reshape(3, -1)
    share = np.divide(unit[0], unit[1], out=np.zeros_like(unit[0]), where=unit[1] > 0.0)
    in_angle = np.stack([np.ones_like(share), share])  # of a compliance: at the largest load
    (before, _), (after, doubt) = (one.offsets for one in (tracked.history.life, life))
    moved, doubt = in_angle * (after - before)[:2], in_angle * doubt[:2]
    told = []
    for kind, change, deviation in zip(("bias", "sag"), moved, doubt, strict=True):
        worst = int(np.argmax(np.abs(change)))
        degrees, error = np.rad2deg(change[worst]), np.rad2deg(deviation[worst])
        motor = life.model.motor_names[worst]
        told.append(f"{kind} of {motor} {degrees:+.2f} deg (deviation {error:.2f})")
    return f"largest changes: {', '.join(told)}"
