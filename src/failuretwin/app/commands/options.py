"""Options that several verbs share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import click

F = TypeVar("F", bound=Callable[..., Any])

PATH = click.Path(path_type=Path)


@dataclass(frozen=True)
class LogOptions:
    """How logs become runs, as the command line says it.

    Attributes:
        how: Raw sessions as `measured` or as `published`.
        published_labels: Take the truth from the names of folders.
        columns: File that says what the columns of a CSV file, or the topics of a bag, are.
        approximate: Accept commands that fit a published path only approximately.
    """

    how: str
    published_labels: bool
    columns: Path | None
    approximate: bool


@dataclass(frozen=True)
class LiveOptions:
    """Topics, the emulated robot and the pace of time, as the command line says it.

    Attributes:
        topics: File with names and types of the robot's ROS topics.
        faults: Faults of an emulated robot, such as ``motor_3:stuck@40-80``.
        imperfections: Name or file; None: those of the robot's profile.
        speed: How fast the time of logs and emulated robots passes; 0: as fast as possible.
        duration: When to stop [s]; None: with the log, or never.
    """

    topics: Path | None
    faults: tuple[str, ...]
    imperfections: str | None
    speed: float
    duration: float | None


def _gathered(command: F, kind: type[LogOptions] | type[LiveOptions], name: str) -> F:
    """Return the command with the options of one kind gathered in one argument."""

    @wraps(command)
    def with_one(**told: Any) -> Any:
        own = {field.name: told.pop(field.name) for field in fields(kind)}
        return command(**told, **{name: kind(**own)})

    return with_one  # type: ignore[return-value]


def common_options(command: F) -> F:
    """Add `--robot` and `--seed`, which every verb has."""
    command = click.option(
        "--seed",
        type=click.IntRange(min=0),
        default=0,
        show_default=True,
        help="Seed of whatever is drawn by chance.",
    )(command)
    return click.option(
        "--robot",
        default="armpi_fpv",
        show_default=True,
        metavar="NAME|PROFILE",
        help="A bundled robot, or the TOML profile of another.",
    )(command)


calibration_option = click.option(
    "--calibration",
    type=PATH,
    metavar="FILE",
    help="What `calibrate` learned of this robot. Default: the calibration its profile names.",
)


def reading_options(command: F) -> F:
    """Add what says how raw logs become runs; the command gets it as `reading`."""
    command = _gathered(command, LogOptions, "reading")
    command = click.option(
        "--approximate",
        is_flag=True,
        help="Published paths without commands: accept commands that reproduce the desired path "
        "only in the least-squares sense.",
    )(command)
    command = click.option(
        "--columns",
        type=PATH,
        metavar="MAP.toml",
        help="What the columns of a CSV file (or the topics of a bag) are. If MAP.toml does not "
        "exist, a guess is written there for you to check.",
    )(command)
    command = click.option(
        "--published-labels",
        is_flag=True,
        help="Take the truth from folder names that end in _label_K and freeze the motor of labels "
        "1-4 from sample 49 on, as the authors of the data did.",
    )(command)
    return click.option(
        "--as",
        "how",
        type=click.Choice(["measured", "published"]),
        default="measured",
        show_default=True,
        help="Read raw sessions with readings at their times and gaps missing, or drawn out by "
        "straight lines as the authors published them.",
    )(command)


def live_options(command: F) -> F:
    """Add topics, the emulated robot and the pace of time; the command gets them as `live`."""
    command = _gathered(command, LiveOptions, "live")
    command = click.option(
        "--duration",
        type=click.FloatRange(min=0.0, min_open=True),
        metavar="SECONDS",
        help="Stop after this time: by the clock of an emulated robot, else by ours. Default: with "
        "the log, or never.",
    )(command)
    command = click.option(
        "--speed",
        type=click.FloatRange(min=0.0),
        default=1.0,
        show_default=True,
        help="How fast the time of logs and emulated robots passes; 0: as fast as possible.",
    )(command)
    command = click.option(
        "--imperfections",
        metavar="none|NAME|FILE",
        help="What an emulated robot does that its twin does not. Default: what is known of it.",
    )(command)
    command = click.option(
        "--fault",
        "faults",
        multiple=True,
        metavar="MOTOR:MODE@START-END",
        help="A fault of an emulated robot, such as motor_3:stuck@40-80 (repaired after 80 s) or "
        "motor_3:stuck@40. Can be given several times.",
    )(command)
    return click.option(
        "--topics",
        type=PATH,
        metavar="FILE.toml",
        help="Names and types of the robot's ROS topics, see docs/live.md. Default: those of the "
        "data set's authors.",
    )(command)
