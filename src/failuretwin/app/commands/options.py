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
