"""`failuretwin watch` and `emulate`: a robot diagnosed at every sample, and one to try it on."""

from __future__ import annotations

import math
import time
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from failuretwin.app.commands import options as opt
from failuretwin.app.commands.store import (
    LEARNED,
    StoreOptions,
    learned_priors_option,
    recorded_option,
    store_options,
)
from failuretwin.app.terminal import console, tell, until_interrupted
from failuretwin.connection.links import NETWORKS, ROS1
from failuretwin.decision.streaming import STREAMED

if TYPE_CHECKING:
    from failuretwin.app.keepers import LifeKeeper, WatchKeeper
    from failuretwin.app.remembering import RobotRecord
    from failuretwin.connection.links.base import Commander
    from failuretwin.digital_model.calibrated_robot import CalibratedRobot


PROBING = ("idle", "move", *opt.names_of(opt.SafetyOptions))
"""Options of `watch` for its movements of the arm."""


@click.command()
@click.argument("source", metavar="SOURCE")
@opt.file_option(
    "--record",
    "FILE.mcap",
    "Record readings, commands and diagnoses; Foxglove, PlotJuggler and failuretwin read it.",
)
@opt.budget_option
@click.option(
    "--sensing",
    type=click.Choice(STREAMED),
    default=STREAMED[0],
    help="Sensors to use. tool: its position. encoders: joint angles that the motors report, such "
    "as /joint_states; errors show sooner, but a wrong reading is taken for the motor. goals: the "
    "goals that they report to have received; a stuck motor shows sooner.",
)
@opt.flag_option(
    "--track",
    "With --store: begin with what earlier watches have learned of this robot, and keep what this "
    "one learns. A robot that its calibration fits teaches nothing.",
)
@opt.probe_options
@opt.safety_options
@opt.live_options
@store_options
@learned_priors_option
@recorded_option
@opt.plugin_option
@opt.calibrated_robot_options()
def watch(
    source: str,
    record: Path | None,
    budget: float,
    sensing: str,
    track: bool,
    probe: opt.ProbeOptions,
    safety: opt.SafetyOptions,
    live: opt.LiveOptions,
    memory: StoreOptions,
    learned_priors: bool,
    recorded: datetime | None,
    robot: opt.RobotOptions,
) -> None:
    """Watch a robot as a digital shadow: listen, report faults, and move nothing.

    With --probe N, `watch` moves the arm to identify a suspected fault, and back, while nobody else
    commands it. Each order passes the gate of `act` (--speed-share, --floor, --radius); any command
    of others ends it.

    SOURCE is `ros1`, `ros2[://HOST[:PORT]]` (over Zenoh), `rosbridge://HOST[:PORT]`, `emulated` (a
    robot simulated by physics), a log to replay (a raw session, a CSV file, a bag, a recording), or
    your own source, MODULE:CLASS, a class that follows failuretwin.Source. On a ROS network the
    diagnosis is published on /diagnostics. With --store each change is stored before it is printed.
    Stop with Ctrl-C.
    """
    from contextlib import ExitStack

    from failuretwin.app.arms import connect
    from failuretwin.app.live import basis_line, fit_of, watch_until_end
    from failuretwin.app.shadow import Changes, Shadow
    from failuretwin.connection.links.recorder import Recorder
    from failuretwin.connection.links.ros_messages import load_topics
    from failuretwin.connection.links.statuses import statuses
    from failuretwin.core.hypothesis import paper_hypotheses
    from failuretwin.decision.streaming.monitor import monitor
    from failuretwin.decision.streaming.set_up_watch import PROOF
    from failuretwin.decision.test_motions.probing import Prober
    from failuretwin.inference.faults.priors import Priors

    if not probe.probes:
        opt.refuse_unused("nothing is moved without --probe N", *PROBING)
    model, (stored, known) = robot.model, memory.look_up(robot, learned_priors and not track)
    life = _life(memory.needed(stored, "--track")) if track else None
    priors = None
    if learned_priors:
        considered = paper_hypotheses(model.motor_names)
        priors = memory.needed(stored, LEARNED).learned_priors(considered, Priors())
    diagnoser = monitor(known.twin, known.imperfections, budget, sensing, life, priors)
    wait_s = load_topics(live.topics).wait_s
    tell(basis_line(known, robot.calibration, budget, "goals" in sensing))
    # An emulated robot ends by itself, a log when it is over.
    length = live.seconds if live.seconds and source != opt.EMULATED else math.inf
    with ExitStack() as stack:
        probing = probe.probes > 0
        link, sinks = connect(source, model, live, robot.seed, stack, takes_orders=probing)
        prober = None
        if probing:
            commander, rules = cast("Commander", link), probe.rules(source, wait_s)
            prober = Prober(diagnoser, safety.gate(known.robot), commander, rules, robot.seed)
            sinks.append(prober)
        if record is not None:
            sinks.append(stack.enter_context(Recorder(record, model)))
        shadow = Shadow(link, diagnoser, known.twin, sinks, wait_s)
        keeper, changes = None, Changes(model.motor_names)
        if stored is not None:
            keeper = _begun(stored, source, sensing, known, recorded)
        with until_interrupted():
            end_s = time.monotonic() + length
            watch_until_end(shadow, changes, console(), end_s, prober, keeper)
    if keeper is not None:
        keeper.end(shadow.snapshot, decided=diagnoser.fit.seen > PROOF)
    arm = statuses(shadow.snapshot.answer, model.motor_names)[0]
    for line in (fit_of(diagnoser), *changes.recurring, f"last answer: {arm}"):
        tell(line)
    if stored is not None:
        tell("" if life is None else life.keep_watch(diagnoser.life))
        tell(stored.remembered("watch")[0])


def _life(stored: RobotRecord) -> LifeKeeper:
    """Return what keeps that which the robot teaches from watch to watch."""
    from failuretwin.app.keepers import LifeKeeper

    return LifeKeeper(stored, "watch")


def _begun(
    stored: RobotRecord,
    source: str,
    sensing: str,
    known: CalibratedRobot,
    recorded: datetime | None,
) -> WatchKeeper:
    """Return what keeps a watch, whose session has begun; a source that is a path is a log."""
    from failuretwin.app.arms import is_log
    from failuretwin.app.keepers import begin_watch
    from failuretwin.data_knowledge.records.log_files import log_file

    log = log_file(source, recorded) if is_log(source) else None
    if log is None:
        opt.refuse_unused("only logs were recorded before", "recorded")
    basis = stored.basis("watch", f"watch, {sensing}", known)
    return begin_watch(stored, source, basis, log)


@click.command()
@click.option(
    "--to",
    "target",
    default=ROS1,
    metavar="|".join((*NETWORKS, "FILE.mcap")),
    help="Publish on a network, ROS 2 over Zenoh, until interrupted, or write a recording "
    "at once: one minute, or until 20 s after the last fault has begun or been repaired, unless "
    "--seconds says otherwise.",
)
@opt.flag_option(
    "--obey",
    "Obey the topic of commands, such as the orders of `failuretwin act`, instead of moving "
    "at random.",
)
@opt.live_options
@opt.plugin_option
@opt.calibrated_robot_options()
def emulate(
    target: str,
    obey: bool,
    live: opt.LiveOptions,
    robot: opt.RobotOptions,
) -> None:
    """Emulate a robot: random movements, the imperfections of a real arm, faults on a schedule.

    No real robot is needed. Watch it with `failuretwin watch ros1`.
    """
    from failuretwin.app.arms import emulation_with, known_arm, play, play_orders

    known = known_arm(robot.model, robot.calibration)
    emulation = emulation_with(live.faults, known, robot.seed)
    emulate_on = play_orders if obey else play
    emulate_on(target, emulation, live)
