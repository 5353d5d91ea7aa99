"""`failuretwin reach`: what an arm can still reach with a motor held."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.arm_options import floor_option, radius_option
from failuretwin.app.commands.options import PATH, common_options, json_option, report_option
from failuretwin.app.terminal import tell


@click.command()
@click.argument("task", metavar="[TASK.csv]", type=PATH, required=False)
@click.option(
    "--fault",
    metavar="MOTOR:stuck=SIZE",
    help="The motor that is stuck, and where [rad, m for one that slides]. Default: every motor "
    "in turn, all over its travel.",
)
@floor_option
@radius_option
@report_option("Draw a map of the workspace there, reach.png.")
@json_option("Write all points.")
@common_options
def reach(
    task: Path | None,
    fault: str | None,
    floor: float | None,
    radius: float | None,
    report: Path | None,
    json_file: Path | None,
    robot: str,
    seed: int,
) -> None:
    """Say what an arm can still reach: of TASK.csv, or of where its usual movements bring the tool.

    Poses that touch the floor or the arm's own links do not count.
    """
    from failuretwin.app.arms import held_of
    from failuretwin.app.reports.acting_report import by_motor_lines, map_lines, save_map
    from failuretwin.data_knowledge.store import write_records
    from failuretwin.decision.acting.reach import reach as reach_of
    from failuretwin.decision.acting.reach import reach_by_motor, workspace
    from failuretwin.decision.acting.safety import SafetyGate, SafetyLimits
    from failuretwin.decision.acting.task import read_task
    from failuretwin.digital_model.robot import load_robot

    model = load_robot(robot)
    gate = SafetyGate(model, SafetyLimits(floor_m=floor, radius_m=radius))
    points = workspace(model, seed=seed) if task is None else read_task(task)
    if fault is None:
        motors = reach_by_motor(gate, points, seed)
        lines, records = by_motor_lines(motors), [motor.record() for motor in motors]
        maps = [reach_of(gate, points, (m.motor, m.best_angle), seed) for m in motors]
    else:
        maps = [reach_of(gate, points, held_of(fault, model), seed)]
        lines, records = map_lines(maps[0], per_point=task is not None), [maps[0].record()]
    for line in lines:
        tell(line)
    if json_file is not None:
        write_records(records, json_file)
    if report is not None:
        save_map(maps, report)
