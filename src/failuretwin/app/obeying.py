"""An emulated robot on a ROS network that does what it is told."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

from failuretwin.app.commands.options import LiveOptions
from failuretwin.app.emulation import emulation_of
from failuretwin.app.live import topics_of
from failuretwin.connection.commanded_arm import CommandedArm
from failuretwin.connection.links.base import CommandSent, Order, Reading
from failuretwin.connection.links.networks import open_transport
from failuretwin.connection.links.replay import Pace
from failuretwin.connection.links.ros_link import RosSource, robot_sink
from failuretwin.digital_model.robot import Robot

POLL_S = 0.01
"""Longest wait for the arm before commands are heard again [s]."""


def obey_commands(
    network: str,
    robot: Robot,
    live: LiveOptions,
    calibration: str | None,
    seed: int,
    tell: Callable[[str], None],
) -> None:
    """Publish readings and do what the topic of commands says, until interrupted.

    Args:
        network: Where to publish and listen, such as ``ros1``.
        robot: The robot.
        live: Topics, faults, pace and length.
        calibration: Its healthy behaviour; None: what is known of it.
        seed: Seed of all chance.
        tell: Called with what happens.
    """
    emulation = emulation_of(robot, live, seed, calibration)
    topics = topics_of(live.topics)
    arm = CommandedArm(emulation, Pace(live.speed))
    length = live.seconds or math.inf
    with open_transport(network) as transport:
        sink = robot_sink(robot, topics, transport)
        ears = RosSource(robot, topics, transport)
        tell("an emulated robot obeys; stop with Ctrl-C")
        try:
            now, zero = 0.0, time.time()
            while now < length:
                event = arm.poll(POLL_S)
                if isinstance(event, Reading):
                    now = event.time
                    sink.put(replace(event, time=event.time + zero))
                while (heard := ears.poll(0.0)) is not None:
                    if isinstance(heard, CommandSent):
                        arm.send(Order(heard.target, heard.duration))
        except KeyboardInterrupt:
            tell("stopped")
