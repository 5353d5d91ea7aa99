"""An emulated robot that plays on a ROS network or into a recording: at random, or as ordered."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from failuretwin.app.commands.options import LiveOptions
from failuretwin.app.terminal import tell, until_interrupted
from failuretwin.connection.emulated_arm import EmulatedArm, Emulation, Shifts
from failuretwin.connection.links import NETWORKS
from failuretwin.connection.links.base import CommandSent, Order, Reading, Sink
from failuretwin.connection.links.replay import AS_FAST_AS_POSSIBLE, Pace
from failuretwin.connection.links.ros_link import (
    RosSink,
    RosSource,
    is_network,
    open_transport,
)
from failuretwin.connection.links.ros_messages import RosWriter, load_topics
from failuretwin.core.errors import InputError
from failuretwin.failure_behavior.injection import ScheduledFault, state_at

FILE_S, AFTER_S = 60.0, 20.0
"""Default length of a recording, and its minimum length after the last start or end of a fault
[s]."""
POLL_S = 0.01
"""Longest wait for the arm before commands are read again [s]."""


def obey(target: str, emulation: Emulation, live: LiveOptions) -> None:
    """Publish readings and carry out the commands of a network, until interrupted."""
    if not is_network(target):
        raise InputError(f"--obey needs a network to obey, but --to is {target!r}.")
    if live.speed != 1.0:
        raise InputError(
            f"--obey takes commands that are stamped by clocks of speed 1, but --speed is "
            f"{live.speed:g}: stamps would not fit the movements. Leave out --speed."
        )
    topics, arm = load_topics(live.topics), EmulatedArm(emulation, Pace())
    writer = RosWriter(emulation.robot, topics)
    with open_transport(target) as transport, until_interrupted():
        sink = RosSink(writer, transport)
        orders = RosSource(emulation.robot, topics, transport)
        tell("an emulated robot obeys; stop with Ctrl-C")
        now, zero = 0.0, time.time()
        while now < (live.seconds or math.inf):
            event = arm.poll(POLL_S)
            if isinstance(event, Reading):
                now = event.time
                sink.put(replace(event, time=event.time + zero))
            while (heard := orders.poll(0.0)) is not None:
                if isinstance(heard, CommandSent):
                    arm.send(Order(heard.target, heard.duration))


def play(target: str, emulation: Emulation, live: LiveOptions) -> None:
    """Publish or record a robot that moves at random."""
    zero, on_network = time.time(), is_network(target)
    if not on_network and Path(target).suffix != ".mcap":
        places = ", ".join(NETWORKS)
        raise InputError(f"--to is {target!r}, expected {places} or a file that ends in .mcap.")
    length = live.seconds or (math.inf if on_network else _file_length(emulation.schedule))
    pace = Pace(live.speed if on_network else AS_FAST_AS_POSSIBLE)
    source = EmulatedArm(emulation, pace, Shifts(break_s=0.0, duration_s=length))
    state = trouble = ""
    with ExitStack() as stack, until_interrupted():
        sink = _sink(target, emulation, live, stack)
        stack.enter_context(source)
        while not source.ended:
            event = source.poll(1.0)
            if event is None:
                continue
            sink.put(replace(event, time=event.time + zero))
            if sink.trouble != trouble:
                trouble = sink.trouble
                tell(trouble or "going on")
            now = state_at(emulation.schedule, event.time, emulation.robot.motor_names)
            if now != state:
                state = now
                tell(f"{event.time:8.1f} s  {state}")
    if sink.trouble:
        raise InputError(sink.trouble)
    if source.ended and not on_network:
        tell(f"{length:g} s written to {target}")


def _sink(target: str, emulation: Emulation, live: LiveOptions, stack: ExitStack) -> Sink:
    """Return the network or recording that an emulated robot publishes to; the stack closes it."""
    if is_network(target):
        writer = RosWriter(emulation.robot, load_topics(live.topics))
        return RosSink(writer, stack.enter_context(open_transport(target)))
    from failuretwin.connection.links.recorder import Recorder

    return stack.enter_context(Recorder(Path(target), emulation.robot))


def _file_length(schedule: Sequence[ScheduledFault]) -> float:
    """Return the length of a recording that shows all scheduled faults [s]."""
    times = [t for one in schedule for t in (one.start_s, one.end_s) if math.isfinite(t)]
    return max([FILE_S, *(t + AFTER_S for t in times)])
