"""`failuretwin act`, `stop` and `reach`: tasks of an arm that may have a fault."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from failuretwin.app.commands import options as opt
from failuretwin.app.commands.store import StoreOptions, store_options
from failuretwin.app.terminal import show, tell, write_json
from failuretwin.connection.links import NETWORKS, ROS1
from failuretwin.core.errors import InputError

if TYPE_CHECKING:
    from failuretwin.app.remembering import RobotRecord


IN_STORE = Path("store")
"""Name of the history in the store, in place of a file."""


@click.command()
@click.argument("task", metavar="TASK.csv", type=opt.PATH)
@click.option(
    "--strategy",
    type=click.Choice(["diagnose", "feedback", "open"]),
    default="diagnose",
    help="diagnose: react to the fault. feedback: correct the error of the tool, whatever its "
    "cause. open: send each target once.",
)
@opt.count_option("--most-movements", 6, "Maximum number of attempts per target.", least=1)
@opt.count_option("--ask questions", 0, "Maximum number of extra diagnostic movements.")
@click.option(
    "--spare",
    multiple=True,
    metavar="MOTOR[=WEIGHT]",
    help="Motor to spare: plan poses that load and move it less. Can be given several times.",
)
@opt.file_option(
    "--wear history",
    "CAL.history.jsonl|store",
    "History that `diagnose --track` keeps, in a file or in the store: spare motors by their wear.",
)
@opt.json_option("Write one object a target, one a line.")
@opt.arm_options
@opt.safety_options
@store_options
@opt.plugin_option
@opt.calibrated_robot_options()
def act(
    task: Path,
    strategy: str,
    most_movements: int,
    questions: int,
    spare: tuple[str, ...],
    history: Path | None,
    json_file: Path | None,
    arm: opt.ArmOptions,
    safety: opt.SafetyOptions,
    memory: StoreOptions,
    robot: opt.RobotOptions,
) -> None:
    """Bring the tool to the targets of TASK.csv (columns x, y, z in metres; see docs/acting.md).

    Faults of the arm are found on the way, reported, and compensated. Every order passes a gate:
    limits, speed, floor, the arm's own links. Stop with Ctrl-C, or `failuretwin stop`.
    """
    from failuretwin.app.arms import commander_of, is_moved, spared_of
    from failuretwin.app.diary import noting
    from failuretwin.app.reports.acting_report import result_parts
    from failuretwin.decision.acting.session import Acting
    from failuretwin.decision.acting.task import ActingSettings, read_task
    from failuretwin.decision.acting.work import first_standing

    wanted, (stored, known) = read_task(task), memory.look_up(robot)
    settings = ActingSettings(most_movements=most_movements, questions=questions)
    acting = Acting(known, safety.gate(known.robot), strategy, settings, None, robot.seed)
    worn = _tracked_rows(history, memory, stored, known.robot.name)
    acting = replace(acting, spared=spared_of(spare, worn, acting.model, tell))
    with ExitStack() as stack:
        commander = commander_of(arm, known, robot.seed, stack)
        if is_moved(arm):
            with noting(stored, known, strategy) as say:
                results = acting.work(wanted, commander, say, say.note)
        else:
            tell("nothing moves without --move; this is what would be ordered")
            results = acting.dry_run(wanted, first_standing(commander), tell)
    show(*result_parts(results))
    write_json([{"target": k} | r.record() for k, r in enumerate(results, start=1)], json_file)


def _tracked_rows(
    history: Path | None, memory: StoreOptions, stored: RobotRecord | None, robot: str
) -> Sequence[Mapping[str, Any]]:
    """Return what is kept of each run of a followed robot; empty: no history is named.

    Raises:
        InputError: If it cannot be read, holds no run, or is of another robot.
    """
    from failuretwin.connection.tracked_diagnosis import read_rows

    if history is None:
        return ()
    if history == IN_STORE:
        return memory.needed(stored, "--wear store").tracked_rows()
    return read_rows(history, robot)


@click.command()
@opt.place_option(ROS1)
@opt.topics_option
@opt.robot_options
def stop(place: str, topics: Path | None, robot: opt.RobotOptions) -> None:
    """Order an arm to stay where it is; an `act` that works on it ends.

    This is no emergency stop: the order goes through the network like any other. Keep the real one
    in reach.
    """
    from failuretwin.app.arms import commander_of
    from failuretwin.decision.acting.work import bring_to_rest

    if place == opt.EMULATED:
        raise InputError(f"an emulated arm ends with its process. Name {', '.join(NETWORKS)}.")
    with ExitStack() as stack:
        arm = commander_of(opt.ArmOptions(place, (), True, topics), robot.known, robot.seed, stack)
        tell(f"told to stay where it is; {bring_to_rest(arm)}")


@click.command()
@click.argument("task", metavar="[TASK.csv]", type=opt.PATH, required=False)
@click.option(
    "--fault",
    metavar="MOTOR:stuck=SIZE",
    help="Stuck motor and its position [rad, m for one that slides], such as motor_2:stuck=-20deg. "
    "Default: every motor in turn, all over its travel.",
)
@opt.space_options
@opt.output_options("Write all points.", "Draw a map of the workspace there, reach.png.")
@opt.robot_options
def reach(
    task: Path | None,
    fault: str | None,
    safety: opt.SafetyOptions,
    output: opt.OutputOptions,
    robot: opt.RobotOptions,
) -> None:
    """Report what an arm can still reach: of TASK.csv, or of its usual workspace.

    Poses that touch the floor or the arm's own links do not count.
    """
    from failuretwin.app.arms import held_of
    from failuretwin.app.reports.acting_report import by_motor_parts, map_parts, save_map
    from failuretwin.decision.acting.reach import reach as reach_of
    from failuretwin.decision.acting.reach import reach_by_motor, workspace
    from failuretwin.decision.acting.task import read_task

    output.check()
    model, seed = robot.model, robot.seed
    gate = safety.gate(model)
    points = workspace(model, seed=seed) if task is None else read_task(task)
    if fault is None:
        motors = reach_by_motor(gate, points, seed)
        parts, records = by_motor_parts(motors), [motor.record() for motor in motors]
        maps = [reach_of(gate, points, (m.motor, m.best_angle), seed) for m in motors]
    else:
        maps = [reach_of(gate, points, held_of(fault, model), seed)]
        parts, records = map_parts(maps[0], per_point=task is not None), [maps[0].record()]
    show(*parts)
    write_json(records, output.json_file)
    if output.report is not None:
        save_map(maps, output.report)
