"""Arms as the command line names them: emulated ones, those on a ROS network, logs to replay."""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.app.commands.options import EMULATED, ArmOptions, LiveOptions
from failuretwin.app.terminal import tell, until_interrupted
from failuretwin.connection.links import NETWORKS
from failuretwin.connection.links.base import (
    Commander,
    CommandSent,
    Order,
    Reading,
    Sink,
    Source,
    source_from_text,
)
from failuretwin.connection.links.replay import AS_FAST_AS_POSSIBLE, Pace
from failuretwin.connection.links.ros_link import (
    RosCommander,
    RosSink,
    RosSource,
    is_network,
    open_transport,
)
from failuretwin.connection.links.ros_messages import (
    DiagnosticsWriter,
    RosTopics,
    RosWriter,
    load_topics,
)
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.readers.bag_messages import BagTopics
from failuretwin.data_knowledge.readers.column_map import ANGLE_UNITS, LENGTH_UNITS, TIME_UNITS
from failuretwin.decision.acting.planner import stopped_learning, wear_weights
from failuretwin.digital_model.calibrated_robot import (
    CalibratedRobot,
    RobotLike,
    calibrated,
    load_calibration,
)
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.injection import ScheduledFault, state_at
from failuretwin.failure_behavior.mode import FaultMode, SizedMode
from failuretwin.failure_behavior.modes import SteadyStateError, Stuck
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.observation.healthy_model import HealthyModel

if TYPE_CHECKING:
    from failuretwin.connection.emulated_arm import Emulation

PLACES = ", ".join((EMULATED, *NETWORKS))
SOURCES = f"{PLACES}, a log (raw session, bag, .mcap), or a source of your own, MODULE:CLASS"
OWN_CLASS = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*(:.*)?")
"""Name of a source class of the user, see `source_from_text`."""

# Emulated arms.


def emulated_arm(
    robot: RobotLike = "armpi_fpv", faults: Sequence[str] = (), seed: int = 0
) -> Commander:
    """Return an emulated arm (rigid-body physics) that takes orders, as `act` uses it.

    Args:
        robot: The robot: name, profile or calibrated robot.
        faults: Faults of the arm, such as ``motor_3:stuck=-0.4`` or
            ``motor_2:encoder_bias=0.1@20``: MOTOR:MODE[=SIZE][@START[-END]], the size in the unit
            of the mode [rad], times in seconds.
        seed: Seed of all random draws.

    Raises:
        InputError: If a fault cannot be read, or mujoco is missing.
    """
    from failuretwin.connection.emulated_arm import EmulatedArm

    return EmulatedArm(emulation_with(faults, calibrated(robot), seed))


def known_arm(robot: Robot, calibration: Path | None = None) -> CalibratedRobot:
    """Return an emulated robot; None: with the calibration of its profile, or the ideal twin."""
    ideal = calibration is None and robot.imperfections_file is None
    return load_calibration("none" if ideal else calibration, robot)


def emulation_with(faults: Sequence[str], known: CalibratedRobot, seed: int) -> Emulation:
    """Return the settings of an emulated arm with faults, written as for `emulated_arm`.

    The size of a stuck motor is its position. Without a start a fault begins at once.
    """
    from failuretwin.connection.emulated_arm import Emulation

    motors = known.robot.motor_names
    start = known.robot.resting_pose.tolist()
    schedule, modes, sizes = [], dict(MODES), dict[str, float]()
    for text in faults:
        name, _, when = text.partition("@")
        kind, _, size = name.partition("=")
        scheduled = ScheduledFault.parse(f"{kind}@{when or '0'}", motors)
        schedule.append(scheduled)
        if not size:
            continue
        mode = modes[scheduled.fault.mode]
        unit = known.robot.own_unit(scheduled.fault.motor, mode.unit)
        value = size_of(size, unit, f"fault {text!r}: size")
        if isinstance(mode, Stuck):
            start[motors.index(scheduled.fault.motor)] = value
        elif sizes.setdefault(mode.mode, value) == value:
            modes[mode.mode] = _of_size(mode, value, text)
        else:
            raise InputError(
                f"fault {text!r}: mode {mode.mode!r} has the size {sizes[mode.mode]:g} "
                "already. An emulated arm has one size of each mode; give the same."
            )
    return Emulation(known.robot, known.imperfections, tuple(schedule), seed, modes, tuple(start))


def _of_size(mode: FaultMode, size: float, text: str) -> FaultMode:
    if isinstance(mode, SteadyStateError):
        return replace(mode, magnitude=(size, size))
    if not isinstance(mode, SizedMode):
        raise InputError(f"fault {text!r}: mode {mode.mode!r} has no size to choose. Leave it out.")
    signs: dict[str, Any] = {"both_signs": False} if mode.signed else {}
    return replace(mode, magnitude=(size, size), **signs)


# Arms that `act` and `check` command.


def is_moved(arm: ArmOptions) -> bool:
    """Return whether orders are sent to an arm: emulated arms need no --move."""
    if arm.place != EMULATED and not is_network(arm.place):
        raise InputError(f"--on is {arm.place!r}, expected {PLACES}.")
    return arm.move or arm.place == EMULATED


def commander_of(arm: ArmOptions, known: CalibratedRobot, seed: int, stack: ExitStack) -> Commander:
    """Return the arm that a command moves; the stack closes it."""
    is_moved(arm)
    if arm.place == EMULATED:
        return stack.enter_context(emulated_arm(known, arm.faults, seed))
    _refuse_faults(arm.faults, arm.place)
    topics = load_topics(arm.topics)
    topics.check_fits(known.robot)
    transport = stack.enter_context(open_transport(arm.place))
    return RosCommander(known.robot, topics, transport)


def _refuse_faults(faults: Sequence[str], place: str) -> None:
    if faults:
        raise InputError(
            f"--fault is of an emulated arm, but the arm is {place!r}. Leave it out, or name "
            f"{EMULATED!r}."
        )


# Arms that `watch` listens to.


def connect(
    text: str,
    robot: Robot,
    live: LiveOptions,
    seed: int,
    stack: ExitStack,
    *,
    takes_orders: bool = False,
) -> tuple[Source, list[Sink]]:
    """Return the source that a SOURCE on the command line names, and the sinks of its network.

    The stack closes them. With `takes_orders` the source must be a `Commander`; an emulated arm
    then works in shifts, and takes orders in its breaks.
    """
    if text == EMULATED:
        return stack.enter_context(_emulated(robot, live, seed, takes_orders)), []
    _refuse_faults(live.faults, text)
    topics = load_topics(live.topics)
    if is_network(text):
        topics.check_fits(robot)
        transport = stack.enter_context(open_transport(text))
        ros_link = RosCommander if takes_orders else RosSource
        diagnostics = RosSink(DiagnosticsWriter(robot, topics), transport)
        return ros_link(robot, topics, transport), [diagnostics]
    if Path(text).exists():
        source = None if takes_orders else _log(text, robot, topics, Pace(live.speed))
    elif OWN_CLASS.fullmatch(text):
        sys.path.insert(0, "")  # the user's module may lie in the current folder
        source = source_from_text(text, robot)
        if takes_orders and not (hasattr(source, "send") and hasattr(source, "standing")):
            source = None
    else:
        raise InputError(f"source {text!r} does not exist. Expected {SOURCES}.")
    if source is None:
        raise InputError(
            f"source {text!r} can only be listened to, but --probe orders movements. Expected "
            f"{PLACES}, or MODULE:CLASS of a Commander; or leave --probe out."
        )
    return stack.enter_context(source), []


def is_log(source: str) -> bool:
    """Return whether a SOURCE on the command line is a log to replay."""
    return source != EMULATED and Path(source).exists()


def _emulated(robot: Robot, live: LiveOptions, seed: int, takes_orders: bool) -> Source:
    from failuretwin.connection.emulated_arm import EmulatedArm, Shifts

    emulation = emulation_with(live.faults, known_arm(robot), seed)
    pace, length = Pace(live.speed), live.seconds or math.inf
    shifts = Shifts(duration_s=length) if takes_orders else Shifts(break_s=0.0, duration_s=length)
    return EmulatedArm(emulation, pace, shifts)


def _log(text: str, robot: Robot, topics: RosTopics, pace: Pace) -> Source:
    from failuretwin.connection.links.replay import replay

    recorded = BagTopics(topics.command, topics.tool or None, topics.position or None)
    return replay(Path(text), robot, pace, None if topics == RosTopics() else recorded)


# Arms that `emulate` plays on a network or into a recording: at random, or as ordered.

FILE_S, AFTER_S = 60.0, 20.0
"""Default length of a recording, and its minimum length after the last start or end of a fault
[s]."""
POLL_S = 0.01
"""Longest wait for the arm before commands are read again [s]."""


def play_orders(target: str, emulation: Emulation, live: LiveOptions) -> None:
    """Publish readings and carry out the commands of a network, until interrupted."""
    if not is_network(target):
        raise InputError(f"--obey needs a network to obey, but --to is {target!r}.")
    if live.speed != 1.0:
        raise InputError(
            f"--obey takes commands that are stamped by clocks of speed 1, but --speed is "
            f"{live.speed:g}: stamps would not fit the movements. Leave out --speed."
        )
    from failuretwin.connection.emulated_arm import EmulatedArm

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
    from failuretwin.connection.emulated_arm import EmulatedArm, Shifts

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


# Motors and numbers in option texts.


def number_of(value: str, what: str) -> float:
    """Return the finite number that a text holds."""
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{what} is {value!r}, expected a number.")
    return number


OTHER_UNITS = {
    "rad": ("deg", ANGLE_UNITS["deg"]),
    "rad/s": ("deg/s", ANGLE_UNITS["deg"]),
    "m": ("mm", LENGTH_UNITS["mm"]),
    "m/s": ("mm/s", LENGTH_UNITS["mm"]),
    "s": ("ms", TIME_UNITS["ms"]),
    "ratio": ("%", 0.01),
}
"""The other unit in which a size can be given, and its factor, by the unit of the mode."""


def size_of(value: str, unit: str, what: str) -> float:
    """Return the size of a fault in the unit of its mode, such as 0.5deg in rad.

    Args:
        value: A number, in the unit of the mode unless another one follows it.
        unit: The unit of the mode.
        what: What it is, for errors.
    """
    other, factor = OTHER_UNITS.get(unit, (unit, 1.0))
    theirs = value.endswith(other)
    number = value.removesuffix(other if theirs else unit)
    try:
        return number_of(number, what) * (factor if theirs else 1.0)
    except InputError:
        raise InputError(
            f"{what} is {value!r}, expected a number [{unit}], or one with {other} behind it."
        ) from None


def held_of(text: str, robot: Robot) -> tuple[str, float]:
    """Return motor and angle [rad] or position [m] in ``MOTOR:stuck=SIZE``."""
    name, _, size = text.partition("=")
    fault = Hypothesis.parse(name, robot.motor_names).faults
    if len(fault) != 1 or fault[0].mode != "stuck" or not size:
        raise InputError(
            f"--fault is {text!r}, expected MOTOR:stuck=SIZE, such as motor_3:stuck=-20deg."
        )
    unit = robot.own_unit(fault[0].motor, Stuck.unit)
    return fault[0].motor, size_of(size, unit, f"--fault {text!r}: size")


def spared_of(
    texts: Sequence[str],
    rows: Sequence[Mapping[str, Any]],
    model: HealthyModel,
    say: Callable[[str], None],
) -> FloatArray | None:
    """Return the weights of motors to spare, (motor,); None if no motor is spared.

    Texts (MOTOR or MOTOR=WEIGHT) replace the weights from the rows of a history, whose wear is
    told.
    """
    names = model.motor_names
    weight = np.zeros(len(names))
    if rows:
        weight = wear_weights(rows, model)
        worn = [f"{names[k]} {weight[k]:.0%}" for k in np.flatnonzero(weight)]
        say(f"worn, of what is allowed: {', '.join(worn) or 'no motor beyond doubt'}")
        alarm = stopped_learning(rows)
        if alarm:
            say(f"that is from before the history stopped to learn: {alarm}")
    for text in texts:
        name, _, share = text.partition("=")
        Hypothesis.parse(f"{name}:stuck", names)
        value = number_of(share or "1", f"--spare {text!r}: the weight")
        if value < 0.0:
            raise InputError(f"--spare {text!r}: the weight is below 0. Leave the motor out.")
        weight[names.index(name)] = value
    return weight if weight.any() else None
