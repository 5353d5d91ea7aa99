"""`failuretwin watch`: a robot is listened to and diagnosed at every sample."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from failuretwin.app.commands.options import (
    PATH,
    LiveOptions,
    common_options,
    live_options,
    plugin_option,
)

if TYPE_CHECKING:
    from failuretwin.failure_behavior.injection import ScheduledFault


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
@plugin_option
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

    from failuretwin.app.live import EmulationOptions, connect, topics_of, watch_until_end
    from failuretwin.app.shadow import Shadow
    from failuretwin.app.tables import console
    from failuretwin.connection.links.base import Pace
    from failuretwin.connection.links.diagnostics import statuses
    from failuretwin.connection.links.recording import Recorder
    from failuretwin.decision.streaming.diagnoser import monitor
    from failuretwin.digital_model.nonidealities import load_imperfections
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


# `failuretwin emulate`: a robot that exists only as physics, on a network or in a file.

FILE_S, AFTER_S = 60.0, 20.0
"""Length of what is written to a file unless told otherwise, and how long it goes on at least after
the last fault has begun or been repaired [s]."""


@click.command()
@click.option(
    "--to",
    "target",
    default="ros1",
    show_default=True,
    metavar="ros1|FILE.mcap",
    help="Publish as a ROS 1 node until interrupted, or write a recording at once: one minute, or "
    "until 20 s after the last fault has begun or been repaired, unless --duration says otherwise.",
)
@live_options
@plugin_option
@common_options
def emulate(
    target: str,
    live: LiveOptions,
    robot: str,
    seed: int,
) -> None:
    """Play a robot: random movements, the imperfections of a real arm, faults on a schedule.

    Needs no robot. Watch it with `failuretwin watch ros1`.
    """
    from failuretwin.app.live import EmulationOptions, emulated_robot, topics_of
    from failuretwin.connection.links.base import AS_FAST_AS_POSSIBLE, Pace, Sink
    from failuretwin.connection.links.recording import Recorder
    from failuretwin.core.errors import InputError
    from failuretwin.digital_model.robot import load_robot
    from failuretwin.failure_behavior.injection import ScheduledFault, state_at

    model = load_robot(robot)
    schedule = [ScheduledFault.parse(text, model.motor_names) for text in live.faults]
    zero, on_ros = time.time(), target == "ros1"
    if not on_ros and Path(target).suffix != ".mcap":
        raise InputError(f"--to is {target!r}, expected ros1 or a file that ends in .mcap.")
    length = live.duration or (math.inf if on_ros else _file_length(schedule))
    options = EmulationOptions(live.faults, live.imperfections, length, seed)
    source = emulated_robot(
        model, options, Pace(live.speed if on_ros else AS_FAST_AS_POSSIBLE), zero
    )
    sink: Sink
    if on_ros:
        from failuretwin.connection.links.ros1 import Ros1Robot

        sink = Ros1Robot(model, topics_of(live.topics))
    else:
        sink = Recorder(Path(target), model)
    told, trouble = "", ""
    with source, sink:
        try:
            while not source.ended:
                event = source.poll(1.0)
                if event is None:
                    continue
                sink.put(event)
                if sink.trouble != trouble:
                    trouble = sink.trouble
                    click.echo(trouble or "going on")
                state = state_at(schedule, event.time - zero, model.motor_names)
                if state != told:
                    click.echo(f"{event.time - zero:8.1f} s  {state}")
                    told = state
        except KeyboardInterrupt:
            click.echo("stopped")
    if sink.trouble:
        raise InputError(sink.trouble)
    if source.ended and not on_ros:
        click.echo(f"{length:g} s written to {target}")


def _file_length(schedule: Sequence[ScheduledFault]) -> float:
    """Return how much of a life goes into a file [s]: all that is on the schedule, and more."""
    times = [t for one in schedule for t in (one.start_s, one.end_s) if math.isfinite(t)]
    return max([FILE_S, *(t + AFTER_S for t in times)])
