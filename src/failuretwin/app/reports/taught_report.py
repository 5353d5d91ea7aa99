"""What runs that were weighed together taught of their robot, for the technician's page."""

from __future__ import annotations

from failuretwin.app.reports.calibration_report import parameter_table
from failuretwin.app.reports.tables import figures_table
from failuretwin.app.reports.technician_page import Section
from failuretwin.connection.self_calibration import SelfCalibration
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.explanation import joint_names_in


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
