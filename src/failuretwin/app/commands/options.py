"""Options that several commands share: robots, logs, live robots, and the arm that is moved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from inspect import signature
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, TypeVar, cast

import click
from click.core import ParameterSource

import failuretwin as ft
from failuretwin.connection.links import NETWORKS
from failuretwin.core.errors import InputError
from failuretwin.digital_model import DEFAULT_ROBOT

if TYPE_CHECKING:
    import xarray as xr

    from failuretwin.data_knowledge.readers.raw_sessions import As
    from failuretwin.data_knowledge.workers import Workforce
    from failuretwin.decision.acting.safety import SafetyGate
    from failuretwin.decision.test_motions.probing import ProbeRules
    from failuretwin.digital_model.calibrated_robot import CalibratedRobot

F = TypeVar("F", bound=Callable[..., Any])

PATH = click.Path(path_type=Path)
EMULATED = "emulated"
"""Name of an emulated arm, in place of a network."""


def file_option(flag: str, metavar: str, text: str, **more: Any) -> Callable[[F], F]:
    """Return an option that takes a path; the name of the parameter may follow the flag."""
    return click.option(*flag.split(), type=PATH, metavar=metavar, help=text, **more)


def count_option(flag: str, default: int, text: str, least: int = 0) -> Callable[[F], F]:
    """Return an option that takes a number of things; the parameter's name may follow the flag."""
    number = click.IntRange(min=least)
    return click.option(*flag.split(), type=number, default=default, metavar="N", help=text)


def flag_option(flag: str, text: str) -> Callable[[F], F]:
    """Return an option that takes no value."""
    return click.option(flag, is_flag=True, help=text)


def names_of(make: Callable[..., object]) -> tuple[str, ...]:
    """Return the names of the parameters that a group of options has."""
    return tuple(signature(make).parameters)


def gathered(
    make: Callable[..., object], name: str, *options: Callable[[F], F]
) -> Callable[[F], F]:
    """Return a decorator that adds options; the command gets one argument, made of their values."""

    def decorate(command: F) -> F:
        @wraps(command)
        def with_one(**told: Any) -> Any:
            own = {option: told.pop(option) for option in names_of(make) if option in told}
            return command(**told, **{name: make(**own)})

        decorated: Any = with_one
        for option in reversed(options):
            decorated = option(decorated)
        return decorated

    return decorate


def refuse_unused(why: str, *names: str) -> None:
    """Raise InputError if the user has given options that have no effect here, and say why.

    The reason is the beginning of a sentence.
    """
    context = click.get_current_context()
    given = [
        option.opts[0]
        for option in context.command.params
        if option.name in names
        and context.get_parameter_source(option.name) is ParameterSource.COMMANDLINE
    ]
    if given:
        raise InputError(f"{why}: leave out {' and '.join(given)}.")


@dataclass(frozen=True)
class RobotOptions:
    """Values of `robot_options`: the robot, its calibration, and the seed of random draws."""

    robot: str
    seed: int
    calibration: Path | None = None

    @property
    def model(self) -> ft.Robot:
        """The robot of the profile."""
        return ft.load_robot(self.robot)

    @property
    def known(self) -> CalibratedRobot:
        """The robot with its servo loops and healthy behaviour."""
        return ft.load_calibration(self.calibration, self.robot)

    @property
    def words(self) -> str:
        """Options as typed in a command, each after a blank; empty where none was named."""
        robot = "" if self.robot == DEFAULT_ROBOT else f" --robot {quote(self.robot)}"
        file = self.calibration
        return robot + ("" if file is None else f" --calibration {quote(str(file))}")


_robot_and_seed = (
    click.option(
        "--robot",
        default=DEFAULT_ROBOT,
        metavar="NAME|PROFILE",
        help="A bundled robot, or the TOML profile of another.",
    ),
    count_option("--seed", 0, "Seed of random draws."),
)
robot_options = gathered(RobotOptions, "robot", *_robot_and_seed)


def calibrated_robot_options(default: str | None = None) -> Callable[[F], F]:
    """Return `robot_options` with `--calibration`; None: as the robot's profile says."""
    unless = "" if default else " Default: the calibration that the profile names."
    calibration = click.option(
        "--calibration",
        type=PATH,
        default=default,
        metavar="FILE|NAME|generic|none",
        help="Healthy behaviour of the robot: a file that `calibrate` wrote, the name of a bundled "
        f"one, generic (that of its arm class) or none (that of the ideal twin).{unless}",
    )
    return gathered(RobotOptions, "robot", calibration, *_robot_and_seed)


def report_option(text: str) -> Callable[[F], F]:
    """Return the option `--report DIR`."""
    return file_option("--report", "DIR", text)


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
    """Add `--plugin`, which registers fault modes before other options are read."""

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
    return file_option("--json json_file", "FILE", text)


@dataclass(frozen=True)
class OutputOptions:
    """Values of `output_options`: where results go."""

    json_file: Path | None
    report: Path | None

    def check(self, *others: Path | None) -> None:
        """Raise OutputError unless these and other files can be written: ask before any work."""
        from failuretwin.data_knowledge.store import check_fillable, check_writable

        for path in filter(None, (self.json_file, *others)):
            check_writable(path)
        if self.report is not None:
            check_fillable(self.report)


def output_options(json_text: str, report_text: str) -> Callable[[F], F]:
    """Return the options `--json FILE` and `--report DIR`."""
    return gathered(OutputOptions, "output", json_option(json_text), report_option(report_text))


published_labels_option = flag_option(
    "--published-labels",
    "Take the truth of raw sessions from folder names that end in _label_K and freeze the "
    "motor of labels 1-4 from sample 49 on, as the authors of the data did.",
)

topics_option = file_option(
    "--topics",
    "FILE.toml",
    "Names and types of the robot's ROS topics, see docs/live.md. Default: those of the data "
    "set's authors.",
)
budget_option = click.option(
    "--false-alarms-per-100h",
    "budget",
    type=click.FloatRange(0.0, 1000.0, min_open=True),
    default=1.0,
    metavar="N",
    help="Budget of false alarms of a robot in 100 hours of work. A smaller one delays alarms.",
)

fault_option = click.option(
    "--fault",
    "faults",
    multiple=True,
    metavar="MOTOR:MODE[=SIZE][@START[-END]]",
    help="Fault of an emulated robot, such as motor_3:stuck@40-80 (repaired after 80 s), "
    "motor_3:stuck@40, or motor_2:encoder_bias=2deg (SIZE in the unit of its mode, rad, s or a "
    "ratio, unless deg, ms or % follows). Can be given several times.",
)


@dataclass(frozen=True)
class LogOptions:
    """Values of `reading_options`: logs, and how they become runs."""

    logs: tuple[Path, ...]
    how: str
    published_labels: bool
    columns: Path | None

    @property
    def options(self) -> ft.ReadOptions:
        """How logs become runs, but for the map of columns."""
        how = cast("As", self.how)
        return ft.ReadOptions(how, self.published_labels)

    def runs(self, robot: ft.Robot, workforce: Workforce | None = None) -> xr.Dataset:
        """Return the runs of all logs as one run set; None: this process reads them."""
        from failuretwin.app.inputs import read_inputs

        return read_inputs(self.logs, robot, self.options, self.columns, workforce)

    def parts(self, robot: ft.Robot, workforce: Workforce | None = None) -> list[xr.Dataset]:
        """Return the runs of each log as a run set of its own."""
        return [replace(self, logs=(log,)).runs(robot, workforce) for log in self.logs]


reading_options = gathered(
    LogOptions,
    "reading",
    click.argument("logs", nargs=-1, required=True, type=PATH, metavar="LOG..."),
    click.option(
        "--as",
        "how",
        type=click.Choice(["measured", "published"]),
        default="measured",
        help="Read raw sessions with readings at their times and gaps missing, or drawn out by "
        "straight lines as the authors published them.",
    ),
    published_labels_option,
    file_option(
        "--columns",
        "MAP.toml",
        "Meaning of the columns of a CSV file (or the topics of a bag, or the angles of a LeRobot "
        "data set). If MAP.toml does not exist, a guess is written there for you to check. For a "
        "LeRobot data set it may be the calibration file of the arm (.json).",
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


# Commands whose work can be spread over processes.


def _workforce(workers: int, scheduler: str | None) -> Workforce:
    from failuretwin.data_knowledge.workers import Workforce

    return Workforce(workers, scheduler)


def workforce_options(result: str, shared: str) -> Callable[[F], F]:
    """Return the options `--workers N` and `--scheduler ADDRESS`.

    `result` does not depend on them; workers of a scheduler must share the files `shared`.
    """
    return gathered(
        _workforce,
        "workforce",
        count_option(
            "--workers",
            1,
            f"Processes on this machine to spread the work over; {result} do not depend on it.",
            least=1,
        ),
        click.option(
            "--scheduler",
            metavar="ADDRESS",
            help="Dask scheduler whose workers do the work instead, such as tcp://host:8786. They "
            f"must share {shared}.",
        ),
    )


# Commands that move an arm: which one, with which faults, within which limits.

SPEED_SHARE = 0.5


def move_option(when: str = "") -> Callable[[F], F]:
    """Return the option `--move`; `when` says which option it belongs to."""
    return flag_option(
        "--move",
        f"{when}Send orders to a real arm. Without it the orders are only shown. An emulated "
        "arm needs no --move.",
    )


def place_option(default: str) -> Callable[[F], F]:
    """Return the option `--on`, the arm that takes orders: emulated by default, or a real one."""
    kinds = ((EMULATED,) if default == EMULATED else ()) + NETWORKS
    return click.option("--on", "place", default=default, metavar="|".join(kinds), help="The arm.")


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
    place_option(EMULATED),
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

    def gate(self, robot: ft.Robot) -> SafetyGate:
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
    count_option(
        "--probe probes",
        0,
        "Maximum number of diagnostic movements, each with the way back, while a fault is "
        "suspected and the arm stands still. 0: nothing moves.",
    ),
    click.option(
        "--idle",
        type=click.FloatRange(min=1.0),
        default=10.0,
        metavar="SECONDS",
        help="With --probe: minimum time after the last command of others was carried out.",
    ),
    move_option("With --probe: "),
)


_space = (
    click.option(
        "--floor", type=float, metavar="METRES", help="Height of the floor. Default: the base."
    ),
    click.option(
        "--radius",
        type=click.FloatRange(min=0.0),
        metavar="METRES",
        help="Radius of the links, for the distance that they keep. Default: by the arm's reach.",
    ),
)
space_options = gathered(SafetyOptions, "safety", *_space)
safety_options = gathered(
    SafetyOptions,
    "safety",
    click.option(
        "--speed-share",
        type=click.FloatRange(min=0.0, max=1.0, min_open=True),
        default=SPEED_SHARE,
        help="Share of each motor's speed limit that may be used.",
    ),
    *_space,
)
