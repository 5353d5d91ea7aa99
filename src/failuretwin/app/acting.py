"""From the command line to an arm that acts, and what is told of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from failuretwin.app.emulation import emulated_faults, number_of
from failuretwin.app.live import EMULATED, topics_of
from failuretwin.connection.links.base import Commander
from failuretwin.connection.links.networks import NETWORKS, is_network, open_transport
from failuretwin.connection.links.ros_link import RosCommander
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.outcome import TargetResult
from failuretwin.decision.acting.sparing import stopped_learning, wear_weights
from failuretwin.digital_model.calibrated_robot import (
    CalibratedRobot,
    RobotLike,
    calibrated,
)
from failuretwin.inference.observation.healthy_model import HealthyModel

PLACES = f"{EMULATED}, {NETWORKS}"

# The arm.


def emulated_arm(
    robot: RobotLike = "armpi_fpv", faults: Sequence[str] = (), seed: int = 0
) -> Commander:
    """Return an arm that exists only as physics and does what it is told, as `act` takes it.

    Args:
        robot: The robot, its name or its profile, as it is known.
        faults: What is wrong with it, such as ``motor_3:stuck=-0.4`` or
            ``motor_2:encoder_bias=0.1@20``: MOTOR:MODE[=SIZE][@START[-END]], the size in the unit
            of the mode [rad], times in seconds.
        seed: Seed of all chance.

    Raises:
        InputError: If a fault cannot be read, or mujoco is missing.
    """
    from failuretwin.connection.commanded_arm import CommandedArm
    from failuretwin.connection.emulated_arm import Emulation

    known = calibrated(robot)
    own = emulated_faults(faults, known.robot)
    return CommandedArm(
        Emulation(known.robot, known.imperfections, own.schedule, seed, own.modes, own.start)
    )


def is_real(place: str) -> bool:
    """Return whether a place on the command line is a real arm, without looking for it.

    Raises:
        InputError: If it is none of `PLACES`.
    """
    if place != EMULATED and not is_network(place):
        raise InputError(f"--on is {place!r}, expected {PLACES}.")
    return place != EMULATED


def commander_of(
    place: str,
    known: CalibratedRobot,
    faults: Sequence[str],
    seed: int,
    topics: Path | None,
    stack: ExitStack,
) -> Commander:
    """Return the arm that stands for a place on the command line.

    Raises:
        InputError: If it cannot be reached or is none of `PLACES`.
    """
    if not is_real(place):
        return stack.enter_context(emulated_arm(known, faults, seed))
    if faults:
        raise InputError(
            f"--fault is of an emulated arm, but --on is {place!r}. Leave it out, or act on "
            f"{EMULATED!r}."
        )
    transport = stack.enter_context(open_transport(place))
    return RosCommander(known.robot, topics_of(topics), transport)


# Words for results.


def table_lines(results: Sequence[TargetResult]) -> list[str]:
    """Return a line for each target, and one for all."""
    lines = []
    for number, result in enumerate(results, start=1):
        error = "not seen" if math.isnan(result.error_m) else f"{1e3 * result.error_m:5.1f} mm"
        if result.direction_error_rad is not None:
            error += f" {math.degrees(result.direction_error_rad):4.1f} deg"
        state = "reached" if result.reached else result.why
        lines.append(f"{number:4d}  {error:>9s}  {result.movements:2d} movements  {state}")
    reached = sum(result.reached for result in results)
    moves = sum(result.movements for result in results)
    lines.append(f"{reached} of {len(results)} targets reached in {moves} movements")
    return lines


def spared_of(
    texts: Sequence[str], history: Path | None, model: HealthyModel, tell: Callable[[str], None]
) -> FloatArray | None:
    """Return the weight of each motor that is to be spared, (motor,); None: of none.

    Args:
        texts: MOTOR or MOTOR=WEIGHT; it counts instead of what the history says of this motor.
        history: CAL.history.jsonl; None: there is none.
        model: The robot.
        tell: Called with what the history says.

    Raises:
        InputError: If a motor is unknown, a weight is no number, or the history cannot be read.
    """
    names = model.motor_names
    weight = np.zeros(len(names))
    if history is not None:
        weight = wear_weights(history, model)
        worn = [f"{names[k]} {weight[k]:.0%}" for k in np.flatnonzero(weight)]
        tell(f"worn, of what is allowed: {', '.join(worn) or 'no motor beyond doubt'}")
        alarm = stopped_learning(history, model.twin.robot.name)
        if alarm:
            tell(f"that is from before the history stopped to learn: {alarm}")
    for text in texts:
        name, _, share = text.partition("=")
        Hypothesis.parse(f"{name}:stuck", names)
        value = number_of(share or "1", f"--spare {text!r}: the weight")
        if value < 0.0:
            raise InputError(f"--spare {text!r}: the weight is below 0. Leave the motor out.")
        weight[names.index(name)] = value
    return weight if weight.any() else None
