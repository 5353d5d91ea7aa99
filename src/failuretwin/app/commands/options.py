"""Options that several commands share: logs, live robots, and the arm that is moved."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource

if TYPE_CHECKING:
    from failuretwin.decision.acting.safety import SafetyGate
    from failuretwin.decision.test_motions.probing import ProbeRules
    from failuretwin.digital_model.robot import Robot

F = TypeVar("F", bound=Callable[..., Any])

PATH = click.Path(path_type=Path)
EMULATED = "emulated"
"""Name of an emulated arm, where others name a network."""


def gathered(kind: type, name: str, *options: Callable[[F], F]) -> Callable[[F], F]:
    """Return a decorator that adds options; the command gets them as one argument, of `kind`."""

    def decorate(command: F) -> F:
        @wraps(command)
        def with_one(**told: Any) -> Any:
            own = {field.name: told.pop(field.name) for field in fields(kind)}
            return command(**told, **{name: kind(**own)})

        decorated: Any = with_one
        for option in reversed(options):
            decorated = option(decorated)
        return decorated

    return decorate


def refuse_unused(why: str, *names: str) -> None:
    """Refuse options that would do nothing, where the user has given some.

    Args:
        why: Why they would do nothing, the beginning of a sentence.
        names: Names of the parameters.

    Raises:
        InputError: If one was given.
    """
    from failuretwin.core.errors import InputError

    context = click.get_current_context()
    given = [
        option.opts[0]
        for option in context.command.params
        if option.name in names
        and context.get_parameter_source(option.name) is ParameterSource.COMMANDLINE
    ]
    if given:
        raise InputError(f"{why}: leave out {' and '.join(given)}.")


def common_options(command: F) -> F:
    """Add `--robot` and `--seed`, which every verb has."""
    command = click.option(
        "--seed",
        type=click.IntRange(min=0),
        default=0,
        help="Seed of whatever is drawn by chance.",
    )(command)
    return click.option(
        "--robot",
        default="armpi_fpv",
        metavar="NAME|PROFILE",
        help="A bundled robot, or the TOML profile of another.",
    )(command)


calibration_option = click.option(
    "--calibration",
    type=PATH,
    metavar="FILE",
    help="What `calibrate` learned of this robot. Default: the calibration its profile names.",
)


class RenamedOption(click.Option):
    """An option whose last name is an old one: it works, and the help leaves it out."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return the name of the option and its help."""
        shown = copy(self)
        shown.opts = self.opts[:1]
        return click.Option.get_help_record(shown, ctx)


def report_option(text: str, *old_names: str) -> Callable[[F], F]:
    """Return the option `--report DIR`."""
    return click.option(
        "--report", *old_names, cls=RenamedOption, type=PATH, metavar="DIR", help=text
    )


class HypothesesOption(click.Option):
    """`--hypotheses`, whose help names all modes that are known, those of plugins too."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return the name of the option and its help."""
        from failuretwin.failure_behavior.registry import MODES

        record = super().get_help_record(ctx)
        return record and (record[0], f"{record[1]} Modes: {', '.join(MODES)}.")


def hypotheses_option(text: str) -> Callable[[F], F]:
    """Return the option `--hypotheses H,...`."""
    return click.option("--hypotheses", cls=HypothesesOption, metavar="H,...", help=text)


def plugin_option(command: F) -> F:
    """Add `--plugin`, which makes fault modes known before anything else is read or told."""

    def load(context: click.Context, option: click.Parameter, plugins: tuple[str, ...]) -> None:
        if plugins:
            from failuretwin.failure_behavior.registry import load_plugin

            for plugin in plugins:
                load_plugin(plugin)

    return click.option(
        "--plugin",
        multiple=True,
        is_eager=True,
        expose_value=False,
        callback=load,
        metavar="MODULE|FILE.py",
        help="Module with fault modes of your own, see docs/fault_modes.md. Can be given several "
        "times.",
    )(command)


def json_option(text: str) -> Callable[[F], F]:
    """Return the option `--json FILE`."""
    return click.option("--json", "json_file", type=PATH, metavar="FILE", help=text)


published_labels_option = click.option(
    "--published-labels",
    is_flag=True,
    help="Take the truth of raw sessions from folder names that end in _label_K and freeze the "
    "motor of labels 1-4 from sample 49 on, as the authors of the data did.",
)
topics_option = click.option(
    "--topics",
    type=PATH,
    metavar="FILE.toml",
    help="Names and types of the robot's ROS topics, see docs/live.md. Default: those of the data "
    "set's authors.",
)
fault_option = click.option(
    "--fault",
    "faults",
    multiple=True,
    metavar="MOTOR:MODE[=SIZE][@START[-END]]",
    help="Fault of an emulated robot, such as motor_3:stuck@40-80 (repaired after 80 s), "
    "motor_3:stuck@40, or motor_2:slow=0.5 (SIZE in the unit of its mode). Can be given several "
    "times.",
)


@dataclass(frozen=True)
class LogOptions:
    """Values of `reading_options`: how logs become runs."""

    how: str
    published_labels: bool
    columns: Path | None
    approximate: bool


reading_options = gathered(
    LogOptions,
    "reading",
    click.option(
        "--as",
        "how",
        type=click.Choice(["measured", "published"]),
        default="measured",
        help="Read raw sessions with readings at their times and gaps missing, or drawn out by "
        "straight lines as the authors published them.",
    ),
    published_labels_option,
    click.option(
        "--columns",
        type=PATH,
        metavar="MAP.toml",
        help="What the columns of a CSV file (or the topics of a bag, or the angles of a LeRobot "
        "data set) are. If MAP.toml does not exist, a guess is written there for you to check.",
    ),
    click.option(
        "--approximate",
        is_flag=True,
        help="Published paths without commands: accept commands that reproduce the desired path "
        "only in the least-squares sense.",
    ),
)


@dataclass(frozen=True)
class LiveOptions:
    """Values of `live_options`: topics, the emulated robot and the pace of time."""

    topics: Path | None
    faults: tuple[str, ...]
    speed: float
    seconds: float | None


live_options = gathered(
    LiveOptions,
    "live",
    topics_option,
    fault_option,
    click.option(
        "--speed",
        type=click.FloatRange(min=0.0),
        default=1.0,
        help="How fast the time of logs and emulated robots passes; 0: as fast as possible.",
    ),
    click.option(
        "--seconds",
        type=click.FloatRange(min=0.0, min_open=True),
        metavar="SECONDS",
        help="Stop after this time: by the clock of an emulated robot, else by ours. Default: with "
        "the log, or never.",
    ),
)


# Commands that move an arm: which one, with which faults, within which limits.

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
    """Values of `arm_options`: the arm that a command moves."""

    place: str
    faults: tuple[str, ...]
    move: bool
    topics: Path | None


arm_options = gathered(
    ArmOptions,
    "arm",
    click.option(
        "--on",
        "place",
        default=EMULATED,
        metavar="emulated|ros1|ros2|rosbridge://HOST[:PORT]",
        help="The arm.",
    ),
    fault_option,
    move_option(),
    topics_option,
)


@dataclass(frozen=True)
class SafetyOptions:
    """Values of `safety_options`: limits of every order."""

    speed_share: float = SPEED_SHARE
    floor: float | None = None
    radius: float | None = None

    def gate(self, robot: Robot) -> SafetyGate:
        """Return the gate that every order passes."""
        from failuretwin.decision.acting.safety import SafetyGate, SafetyLimits

        limits = SafetyLimits(
            speed_share=self.speed_share, floor_m=self.floor, radius_m=self.radius
        )
        return SafetyGate(robot, limits)


@dataclass(frozen=True)
class ProbeOptions:
    """Values of `probe_options`: diagnostic movements of a watched arm."""

    probes: int
    idle: float
    move: bool

    def rules(self, place: str, wait_s: float) -> ProbeRules:
        """Return the rules of diagnostic movements; commands come up to `wait_s` [s] late."""
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
