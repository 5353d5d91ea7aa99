"""`failuretwin emulate`: a robot that exists only as physics, on a network or in a file."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from failuretwin.app.commands.options import LiveOptions, common_options, live_options

if TYPE_CHECKING:
    from failuretwin.failure_behavior.schedule import ScheduledFault

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
    from failuretwin.app.live.connections import EmulationOptions, emulated_robot, topics_of
    from failuretwin.connection.links.pace import AS_FAST_AS_POSSIBLE, Pace
    from failuretwin.connection.links.recorder import Recorder
    from failuretwin.connection.links.values import Sink
    from failuretwin.core.errors import InputError
    from failuretwin.digital_model.robot import load_robot
    from failuretwin.failure_behavior.schedule import ScheduledFault, state_at

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
        from failuretwin.connection.ros1.sinks import Ros1Robot

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
