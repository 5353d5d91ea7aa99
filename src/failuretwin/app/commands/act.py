"""`failuretwin act`, `stop` and `reach`: tasks of an arm that may have a fault."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import click

from failuretwin.app.commands.options import (
    EMULATED,
    PATH,
    ArmOptions,
    SafetyOptions,
    arm_options,
    calibration_option,
    common_options,
    floor_option,
    json_option,
    plugin_option,
    radius_option,
    report_option,
    safety_options,
    topics_option,
)
from failuretwin.app.terminal import show, tell


@click.command()
@click.argument("task", metavar="TASK.csv", type=PATH)
@click.option(
    "--strategy",
    type=click.Choice(["diagnose", "feedback", "open"]),
    default="diagnose",
    help="React to what is wrong; correct what the tool misses as if nothing were; or send each "
    "target once.",
)
@click.option(
    "--most-movements",
    type=click.IntRange(min=1),
    default=6,
    help="Maximum number of attempts per target.",
)
@click.option(
    "--ask",
    "questions",
    type=click.IntRange(min=0),
    default=0,
    help="Maximum number of extra diagnostic movements.",
)
@click.option(
    "--spare",
    multiple=True,
    metavar="MOTOR[=WEIGHT]",
    help="Motor to spare: plan poses that load and move it less. Can be given several times.",
)
@click.option(
    "--wear",
    "history",
    type=PATH,
    metavar="CAL.history.jsonl",
    help="What `diagnose --track` keeps: motors are spared by how worn they are.",
)
@json_option("Write one object a target, one a line.")
@arm_options
@safety_options
@calibration_option
@plugin_option
@common_options
def act(
    task: Path,
    strategy: str,
    most_movements: int,
    questions: int,
    spare: tuple[str, ...],
    history: Path | None,
    json_file: Path | None,
    arm: ArmOptions,
    safety: SafetyOptions,
    calibration: Path | None,
    robot: str,
    seed: int,
) -> None:
    """Bring the tool to the targets of TASK.csv (columns x, y, z in metres; see docs/acting.md).

    What is wrong with the arm is found out on the way, told, and worked round. Every order passes a
    gate: limits, speed, floor, the arm's own links. Stop with Ctrl-C, or `failuretwin stop`.
    """
    from failuretwin.app.arms import commander_of, is_moved, spared_of
    from failuretwin.app.reports.acting_report import result_parts
    from failuretwin.data_knowledge.store import write_records
    from failuretwin.decision.acting.session import Acting
    from failuretwin.decision.acting.task import ActingSettings, read_task
    from failuretwin.decision.acting.work import first_standing
    from failuretwin.digital_model.calibrated_robot import load_calibration

    known, wanted = load_calibration(calibration, robot), read_task(task)
    acting = Acting(
        known,
        safety.gate(known.robot),
        strategy,
        ActingSettings(most_movements=most_movements, questions=questions),
        None,
        seed,
    )
    acting = replace(acting, spared=spared_of(spare, history, acting.model, tell))
    with ExitStack() as stack:
        commander = commander_of(arm, known, seed, stack)
        if is_moved(arm):
            results = acting.work(wanted, commander, tell)
        else:
            tell("nothing moves without --move; this is what would be ordered")
            results = acting.dry_run(wanted, first_standing(commander), tell)
    show(*result_parts(results))
    if json_file is not None:
        numbered = enumerate(results, start=1)
        write_records(({"target": k} | result.record() for k, result in numbered), json_file)


@click.command()
@click.option(
    "--on", "place", default="ros1", metavar="ros1|ros2|rosbridge://HOST[:PORT]", help="The arm."
)
@topics_option
@common_options
def stop(place: str, topics: Path | None, robot: str, seed: int) -> None:
    """Order an arm to stay where it is; an `act` that works on it hears that and ends.

    This is no emergency stop: it takes the way that every order takes. Keep the real one in reach.
    """
    import numpy as np

    from failuretwin.app.arms import commander_of
    from failuretwin.connection.links.base import Order
    from failuretwin.core.errors import InputError
    from failuretwin.decision.acting.work import where_it_stands
    from failuretwin.digital_model.calibrated_robot import load_calibration

    if place == EMULATED:
        raise InputError(
            "an emulated arm ends with its process. Name ros1, ros2 or rosbridge://HOST."
        )
    known = load_calibration("none", robot)
    with ExitStack() as stack:
        arm = commander_of(ArmOptions(place, (), True, topics), known, seed, stack)
        target = where_it_stands(arm)
        arm.send(Order(target, np.full(len(target), 0.1)))
        tell("told to stay where it is")


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
    from failuretwin.app.reports.acting_report import by_motor_parts, map_parts, save_map
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
        parts, records = by_motor_parts(motors), [motor.record() for motor in motors]
        maps = [reach_of(gate, points, (m.motor, m.best_angle), seed) for m in motors]
    else:
        maps = [reach_of(gate, points, held_of(fault, model), seed)]
        parts, records = map_parts(maps[0], per_point=task is not None), [maps[0].record()]
    show(*parts)
    if json_file is not None:
        write_records(records, json_file)
    if report is not None:
        save_map(maps, report)
