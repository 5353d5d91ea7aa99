"""`failuretwin watch`: a robot is listened to and diagnosed at every sample."""

from __future__ import annotations

import math
import time
from pathlib import Path

import click

from failuretwin.app.commands.options import PATH, LiveOptions, common_options, live_options


@click.command()
@click.argument("source", metavar="SOURCE")
@click.option(
    "--calibration",
    type=PATH,
    metavar="FILE",
    help="What `calibrate` learned of this robot. Default: the calibration its profile names.",
)
@click.option(
    "--record",
    type=PATH,
    metavar="FILE.mcap",
    help="Record readings, commands and diagnoses; Foxglove, PlotJuggler and failuretwin read it.",
)
@live_options
@common_options
def watch(
    source: str,
    calibration: Path | None,
    record: Path | None,
    live: LiveOptions,
    robot: str,
    seed: int,
) -> None:
    """Watch a robot as a digital shadow: it listens, says what is wrong, and moves nothing.

    SOURCE is `ros1`, `rosbridge://HOST[:PORT]`, `emulated` (a robot that exists only as physics),
    or a log to replay: a raw session, a bag, a recording. On a ROS network the diagnosis is
    published on /diagnostics. Stop with Ctrl-C.
    """
    from contextlib import ExitStack

    from failuretwin.app.console import console
    from failuretwin.app.live.connections import EmulationOptions, connect, topics_of
    from failuretwin.app.live.shadow import Shadow
    from failuretwin.app.live.watching import watch_until_end
    from failuretwin.connection.links.diagnostic_status import statuses
    from failuretwin.connection.links.pace import Pace
    from failuretwin.connection.links.recorder import Recorder
    from failuretwin.decision.streaming.streaming import monitor
    from failuretwin.digital_model.imperfections import load_imperfections
    from failuretwin.digital_model.robot import load_robot
    from failuretwin.digital_model.twin import DigitalTwin

    model, names = load_robot(robot), topics_of(live.topics)
    twin = DigitalTwin(model)
    healthy = None if calibration is None else load_imperfections(str(calibration), model)
    diagnoser = monitor(twin, healthy)
    length = math.inf if live.duration is None else live.duration
    options = EmulationOptions(live.faults, live.imperfections, length, seed)
    with ExitStack() as stack:
        connections = connect(source, model, names, options, Pace(live.speed), stack)
        sinks = list(connections.sinks)
        if record is not None:
            sinks.append(stack.enter_context(Recorder(record, model)))
        shadow = Shadow(connections.source, diagnoser, twin, sinks, names.wait_s)
        try:
            # An emulated robot ends by itself, a log when it is over.
            until = time.monotonic() + (length if source != "emulated" else math.inf)
            watch_until_end(shadow, connections.source, sinks, model.motor_names, console(), until)
        except KeyboardInterrupt:
            click.echo("stopped")
    arm = statuses(shadow.moment.answer, model.motor_names)[0]
    click.echo(f"last answer: {arm.message}")
