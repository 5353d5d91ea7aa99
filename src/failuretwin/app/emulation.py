"""From the command line to an emulated arm: its imperfections, its faults and their sizes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from failuretwin.core.errors import InputError
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.injection import ScheduledFault
from failuretwin.failure_behavior.mode import FaultMode, SizedMode
from failuretwin.failure_behavior.modes import SteadyStateError, Stuck
from failuretwin.failure_behavior.registry import MODES

if TYPE_CHECKING:
    from failuretwin.app.commands.options import LiveOptions
    from failuretwin.connection.emulated_arm import Emulation


@dataclass(frozen=True)
class EmulatedFaults:
    """Faults that an emulated arm has: when, how large, and where it stands at first.

    Attributes:
        schedule: What comes when.
        modes: Fault modes with the sizes that were asked for.
        start: Where the motors stand at first, (motor,) [rad].
    """

    schedule: tuple[ScheduledFault, ...]
    modes: dict[str, FaultMode]
    start: tuple[float, ...]


def emulated_faults(texts: Sequence[str], robot: Robot) -> EmulatedFaults:
    """Read faults such as ``motor_3:stuck``, ``motor_3:stuck=-0.4@20`` or ``motor_2:slow=0.5``.

    Args:
        texts: MOTOR:MODE[=SIZE][@START[-END]], the size in the unit of the mode; of a stuck motor
            it is where it stands. Without a start it is there from the beginning.
        robot: The robot.

    Raises:
        InputError: If one cannot be read, its mode has no size to choose, or two sizes.
    """
    schedule, modes, sizes = [], dict(MODES), dict[str, float]()
    start = robot.resting_pose.tolist()
    for text in texts:
        name, _, when = text.partition("@")
        kind, _, size = name.partition("=")
        scheduled = ScheduledFault.parse(f"{kind}@{when or '0'}", robot.motor_names)
        schedule.append(scheduled)
        if size:
            value = number_of(size, f"fault {text!r}: size")
            mode = modes[scheduled.fault.mode]
            if isinstance(mode, Stuck):
                start[robot.motor_names.index(scheduled.fault.motor)] = value
            else:
                modes[mode.mode] = _of_size(mode, value, text)
                if sizes.setdefault(mode.mode, value) != value:
                    raise InputError(
                        f"fault {text!r}: mode {mode.mode!r} has the size {sizes[mode.mode]:g} "
                        "already. An emulated arm has one size of each mode; give the same."
                    )
    return EmulatedFaults(tuple(schedule), modes, tuple(start))


def _of_size(mode: FaultMode, size: float, text: str) -> FaultMode:
    if isinstance(mode, SteadyStateError):
        return replace(mode, magnitude=(size, size))
    if not isinstance(mode, SizedMode):
        raise InputError(f"fault {text!r}: mode {mode.mode!r} has no size to choose. Leave it out.")
    signs: dict[str, Any] = {"both_signs": False} if mode.signed else {}
    return replace(mode, magnitude=(size, size), **signs)


def number_of(value: str, what: str) -> float:
    """Return the number that a text says.

    Raises:
        InputError: If it is none, naming `what` it is.
    """
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{what} is {value!r}, expected a number.")
    return number


def emulation_of(
    robot: Robot, live: LiveOptions, seed: int, calibration: str | None = None
) -> Emulation:
    """Return what an emulated arm is, with faults of sizes that are asked for.

    Args:
        robot: The robot, as it is without faults.
        live: Its faults.
        seed: Seed of all chance.
        calibration: Its healthy behaviour; None: what is known of it.

    Raises:
        InputError: If a fault or the imperfections cannot be read.
    """
    from failuretwin.connection.emulated_arm import Emulation

    own = "none" if robot.imperfections_file is None else robot.name
    known = load_calibration(calibration or own, robot)
    asked = emulated_faults(live.faults, robot)
    return Emulation(
        known.robot, known.imperfections, asked.schedule, seed, asked.modes, asked.start
    )
