"""What `bridge` does: a robot, or a fleet of emulated ones, onto the broker."""

from __future__ import annotations

import asyncio
import math
import time
from contextlib import ExitStack
from dataclasses import replace

from failuretwin.app.arms import connect, emulation_with
from failuretwin.app.commands.options import LiveOptions, RobotOptions
from failuretwin.app.fleet import run_until_stopped
from failuretwin.app.terminal import tell
from failuretwin.connection.fleet.bridge import Publisher, bridge_fleet, bridge_source
from failuretwin.connection.fleet.broker import Access, open_broker
from failuretwin.connection.fleet.emulated_fleet import EmulatedFleet
from failuretwin.connection.fleet.messages import ROBOT_NAME, ProfileMessage
from failuretwin.core.errors import InputError, counted
from failuretwin.core.foreign import read_text


def bridge_one(
    access: Access, source: str, name: str, live: LiveOptions, robot: RobotOptions
) -> None:
    """Put one robot on the broker until its source ends, or until stopped."""
    profile = _profile(name, robot)

    async def main(stop: asyncio.Event) -> None:
        with ExitStack() as stack:
            link, _ = connect(source, robot.model, live, robot.seed, stack)
            async with await open_broker(access, f"bridge-{name}") as broker:
                publisher = Publisher(broker, tell, stop, len(robot.model.motors))
                await publisher.announce([name], profile)
                tell(f"{name}: {link.name} to {access.shown}; stop with Ctrl-C")
                await bridge_source(link, name, publisher, stop)
            tell(f"{counted(publisher.sent, 'message')} sent, {link.counts.dropped} events dropped")

    run_until_stopped(main)


def bridge_emulated(
    access: Access, name: str, robots: int, live: LiveOptions, robot: RobotOptions
) -> None:
    """Put emulated robots on the broker; each fault is that of one of them, spread evenly."""
    profile, known = _profile(name, robot), robot.known
    own: dict[int, list[str]] = {}
    for k, fault in enumerate(live.faults):
        own.setdefault(k * robots // len(live.faults), []).append(fault)
    arms = [
        (
            f"{name}_{k}" if robots > 1 else name,
            replace(emulation_with(own.get(k, ()), known, robot.seed + k), seed=robot.seed + k),
        )
        for k in range(robots)
    ]

    async def main(stop: asyncio.Event) -> None:
        async with await open_broker(access, f"bridge-{name}") as broker:
            publisher = Publisher(broker, tell, stop, len(robot.model.motors))
            fleet = EmulatedFleet(arms, time.time(), live.seconds or math.inf)
            await publisher.announce(fleet.names, profile)
            tell(f"{counted(robots, 'emulated robot')} to {access.shown}; stop with Ctrl-C")
            await bridge_fleet(fleet.second, publisher, stop, live.speed)
        tell(f"{counted(publisher.sent, 'message')} sent")

    run_until_stopped(main)


def _profile(name: str, robot: RobotOptions) -> ProfileMessage:
    if not ROBOT_NAME.fullmatch(name):
        raise InputError(f"robot name {name!r}: expected letters, digits, - and _, 64 at most.")
    if robot.calibration is None:
        return ProfileMessage(robot.model.name)
    if not robot.calibration.is_file():
        raise InputError(f"--calibration {robot.calibration}: expected a file, to be sent along.")
    return ProfileMessage(robot.model.name, read_text(robot.calibration, "a calibration"))
