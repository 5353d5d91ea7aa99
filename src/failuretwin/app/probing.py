"""From the command line to an arm that is watched, and asked by movements where that is wanted."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import cast

from failuretwin.app.commands.options import LiveOptions
from failuretwin.app.emulation import emulation_of
from failuretwin.app.live import (
    EMULATED,
    OWN_CLASS,
    connect,
    missing,
)
from failuretwin.connection.links.base import Commander, Sink
from failuretwin.connection.links.networks import NETWORKS, is_network
from failuretwin.connection.links.replay import Pace
from failuretwin.core.errors import InputError
from failuretwin.digital_model.robot import Robot


def commanded(
    text: str, robot: Robot, live: LiveOptions, seed: int, stack: ExitStack
) -> tuple[Commander, list[Sink]]:
    """Return the arm that a SOURCE stands for, to be watched and commanded; see `connect`.

    Raises:
        InputError: If it can only be listened to, or as `connect` says.
    """
    if text == EMULATED:
        return stack.enter_context(_at_work(robot, live, seed)), []
    own = OWN_CLASS.fullmatch(text) and not Path(text).exists()
    if not own and not is_network(text):
        raise _listens(text) if Path(text).exists() else missing(text)
    link, sinks = connect(text, robot, live, seed, stack, commands=True)
    if not (hasattr(link, "send") and hasattr(link, "standing")):
        raise _listens(text)
    return cast(Commander, link), sinks


def _listens(text: str) -> InputError:
    return InputError(
        f"source {text!r} can only be listened to, but --probe orders movements. Expected "
        f"{EMULATED}, {NETWORKS}, or MODULE:CLASS of a Commander; or leave --probe out."
    )


def _at_work(robot: Robot, live: LiveOptions, seed: int) -> Commander:
    """Return an emulated arm that somebody works with; its faults may have sizes."""
    from failuretwin.connection.commanded_arm import OperatedArm, Shifts

    shifts = Shifts(duration_s=live.seconds or math.inf)
    return OperatedArm(emulation_of(robot, live, seed), shifts, Pace(live.speed))
