"""`failuretwin robot`: bring a robot of your own, from its URDF."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import PATH, F


def link_options(command: F) -> F:
    """Add what says where the chain begins and ends."""
    command = click.option(
        "--tool",
        metavar="LINK",
        help="Link whose origin is the tool point. Default: the end of the branch with the most "
        "moving joints.",
    )(command)
    return click.option(
        "--base", metavar="LINK", help="Link that carries the base frame. Default: the root."
    )(command)


@click.group()
def robot() -> None:
    """Look a URDF over and make a robot profile of it."""


@robot.command()
@click.argument("urdf", type=PATH)
@link_options
def check(urdf: Path, base: str | None, tool: str | None) -> None:
    """Say whether a URDF can be used, which motors move the tool, and what is missing."""
    from failuretwin.app.reports import print_report
    from failuretwin.digital_model.urdf_check import check_urdf

    report = check_urdf(urdf, base, tool)
    print_report(report)
    report.raise_errors()


@robot.command()
@click.argument("urdf", type=PATH)
@click.option("--out", required=True, type=PATH, metavar="PROFILE", help="Profile to write: .toml.")
@link_options
def init(urdf: Path, out: Path, base: str | None, tool: str | None) -> None:
    """Write a commented profile for the robot of a URDF, ready for --robot PROFILE."""
    from failuretwin.core.errors import InputError
    from failuretwin.data_knowledge.store import replacing
    from failuretwin.digital_model.robot import load_robot, profile_text
    from failuretwin.digital_model.urdf_check import check_urdf

    if out.suffix != ".toml":
        raise InputError(f"{out}: a profile ends in .toml. Give such a name.")
    if out.exists():
        raise InputError(f"{out}: exists already. Choose another name, or remove it first.")
    report = check_urdf(urdf, base, tool)
    text = profile_text(report, out)
    with replacing(out) as partial:
        partial.write_text(text, encoding="utf-8")
        load_robot(partial)
    for message in report.having("warning"):
        click.echo(f"warning: {message}", err=True)
    count = len(report.motors)
    click.echo(
        f"profile with {count} motor{'s' * (count != 1)} written to {out}; go through the "
        "lines that say 'assumed'"
    )
