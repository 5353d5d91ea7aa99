"""Options that several verbs share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

F = TypeVar("F", bound=Callable[..., Any])

PATH = click.Path(path_type=Path)


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


def reading_options(command: F) -> F:
    """Add what says how raw logs become runs."""
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
    """Add what `emulate` and `watch` share: topics, the emulated robot, the pace of time."""
    command = click.option(
        "--duration",
        type=click.FloatRange(min=0.0, min_open=True),
        metavar="SECONDS",
        help="Stop after this time. Default: with the log, or never.",
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
