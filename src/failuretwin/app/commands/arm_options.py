"""Options of commands that move an arm: which one, with what wrong, within which limits."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from failuretwin.app.commands.options import F, fault_option, gathered, topics_option

if TYPE_CHECKING:
    from failuretwin.connection.links.base import Commander
    from failuretwin.decision.acting.safety import SafetyGate
    from failuretwin.decision.test_motions.probing import ProbeRules
    from failuretwin.digital_model.calibrated_robot import CalibratedRobot
    from failuretwin.digital_model.robot import Robot

SPEED_SHARE = 0.5


def move_option(when: str = "") -> Callable[[F], F]:
    """Return the option `--move`; `when` says which option it belongs to."""
    return click.option(
        "--move",
        is_flag=True,
        help=f"{when}Send orders to a real arm. Without it the orders are only shown. An emulated "
        "arm needs no --move.",
    )


floor_option = click.option(
    "--floor", type=float, metavar="METRES", help="Height of the floor. Default: the base."
)
radius_option = click.option(
    "--radius",
    type=click.FloatRange(min=0.0),
    metavar="METRES",
    help="Radius of the links, for the distance that they keep. Default: by the arm's reach.",
)


@dataclass(frozen=True)
class ArmOptions:
    """Which arm is moved, as the help texts of `arm_options` say it."""

    place: str
    faults: tuple[str, ...]
    move: bool
    topics: Path | None

    @property
    def moves(self) -> bool:
        """Whether orders are really sent.

        Raises:
            InputError: If there is no such place.
        """
        from failuretwin.app.arms import is_real

        return not is_real(self.place) or self.move

    def commander(self, known: CalibratedRobot, seed: int, stack: ExitStack) -> Commander:
        """Return the arm; it is left alone again when the stack closes."""
        from failuretwin.app.arms import commander_of

        return commander_of(self.place, known, self.faults, seed, self.topics, stack)


arm_options = gathered(
    ArmOptions,
    "arm",
    click.option(
        "--on",
        "place",
        default="emulated",
        metavar="emulated|ros1|ros2|rosbridge://HOST[:PORT]",
        help="The arm.",
    ),
    fault_option,
    move_option(),
    topics_option,
)


@dataclass(frozen=True)
class SafetyOptions:
    """Which orders are allowed, as the help texts of `safety_options` say it."""

    speed_share: float = SPEED_SHARE
    floor: float | None = None
    radius: float | None = None

    def gate(self, robot: Robot) -> SafetyGate:
        """Return what every order has to pass."""
        from failuretwin.decision.acting.safety import SafetyGate, SafetyLimits

        limits = SafetyLimits(
            speed_share=self.speed_share, floor_m=self.floor, radius_m=self.radius
        )
        return SafetyGate(robot, limits)


@dataclass(frozen=True)
class ProbeOptions:
    """Whether a watched arm is asked by movements, as the help texts of `probe_options` say it."""

    probes: int
    idle: float
    move: bool

    def rules(self, place: str, wait_s: float) -> ProbeRules:
        """Return when the arm at a place is asked; commands may come so late [s]."""
        from failuretwin.app.arms import EMULATED
        from failuretwin.decision.test_motions.probing import ProbeRules

        return ProbeRules(self.probes, self.idle + wait_s, self.move or place == EMULATED)


probe_options = gathered(
    ProbeOptions,
    "probe",
    click.option(
        "--probe",
        "probes",
        type=click.IntRange(min=0),
        default=0,
        metavar="N",
        help="While a fault is suspected and the arm stands still, make N movements at most that "
        "settle which, each with the way back. Default: 0, nothing moves.",
    ),
    click.option(
        "--idle",
        type=click.FloatRange(min=1.0),
        default=10.0,
        show_default=True,
        metavar="SECONDS",
        help="With --probe: only so long after the last command of others was carried out.",
    ),
    move_option("With --probe: "),
)


safety_options = gathered(
    SafetyOptions,
    "safety",
    click.option(
        "--speed-share",
        type=click.FloatRange(min=0.0, max=1.0, min_open=True),
        default=SPEED_SHARE,
        help="Share of each motor's speed limit that may be used.",
    ),
    floor_option,
    radius_option,
)
