"""`failuretwin store`, `history`, `found`, `repaired` and `query`: what robots went through."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

import failuretwin as ft
from failuretwin.app.commands import options as opt
from failuretwin.app.terminal import show, tell
from failuretwin.core.errors import InputError, counted
from failuretwin.data_knowledge.records import CHECK_DAYS

if TYPE_CHECKING:
    from failuretwin.app.remembering import RobotRecord
    from failuretwin.digital_model.calibrated_robot import CalibratedRobot

# Options of commands that use the store.

STORE_VARIABLE = "FAILURETWIN_STORE"
"""Environment variable with the store that commands use by default."""
store_option = click.option(
    "--store",
    envvar=STORE_VARIABLE,
    show_envvar=True,
    metavar="URL",
    help="Store of robots: the path of an SQLite file, or postgresql://USER@HOST/DATABASE. See "
    "docs/store.md.",
)


@dataclass(frozen=True)
class StoreOptions:
    """Values of `store_options`: where results are remembered, and as which robot's."""

    store: str | None
    robot_name: str | None

    def look_up(
        self, robot: opt.RobotOptions, learned: bool = False
    ) -> tuple[RobotRecord | None, CalibratedRobot]:
        """Return the robot in the store, and as it is calibrated.

        It has the calibration of `--calibration`, else the one in force in the store, else, if
        `learned`, the population of its kind there, else that of its profile. Without `--store`
        there is no record.
        """
        record = self.record(robot)
        if record is None or robot.calibration is not None:
            return record, robot.known
        record = record.with_calibration()
        kind = record.population if learned else None
        return record, record.calibrated or kind or robot.known

    def needed(self, stored: RobotRecord | None, option: str) -> RobotRecord:
        """Return the robot in the store, which an option needs.

        Raises:
            InputError: If there is no store.
        """
        if stored is None:
            raise InputError(f"{option} needs a store. Name one: --store robots.db.")
        return stored

    def record(self, robot: opt.RobotOptions) -> RobotRecord | None:
        """Return the robot in the store; None: nothing is remembered."""
        if not self.store:
            opt.refuse_unused("nothing is remembered without --store", "robot_name", "recorded")
            return None
        store = ft.open_store(self.store)
        from failuretwin.app.remembering import RobotRecord

        model = robot.model
        return RobotRecord(store, self.robot_name or model.name, model)


store_options = opt.gathered(
    StoreOptions,
    "memory",
    store_option,
    click.option(
        "--robot-name",
        metavar="NAME",
        help="With --store: name of this very robot. Default: the name of its profile.",
    ),
)
LEARNED = "--learned-priors"
learned_priors_option = opt.flag_option(
    LEARNED,
    "With --store: faults that people confirmed at robots of this kind count more, others less, "
    "than by the assumed rates. A robot without a calibration counts as one of the calibrated "
    "robots of its kind.",
)
recorded_option = click.option(
    "--recorded",
    type=click.DateTime(["%Y-%m-%d", "%Y-%m-%dT%H:%M", "%Y-%m-%dT%H:%M:%S"]),
    metavar="TIME",
    help="With --store: when the logs were recorded (UTC), such as 2026-03-02T14:30. Default: when "
    "each was last modified.",
)


# Commands.

person_option = click.option("--by", "person", default="", metavar="NAME", help="Who says so.")
note_option = click.option("--note", default="", metavar="TEXT", help="Anything else.")


def _url(store: str | None) -> str:
    if not store:
        raise InputError(
            f"no store is named. Name one: --store robots.db, or set {STORE_VARIABLE}."
        )
    return store


@click.group()
def store() -> None:
    """Make, upgrade, check and export the store of robots."""


@store.command()
@store_option
def init(store: str | None) -> None:
    """Make a store. One that is there stays as it is."""
    made = ft.open_store(_url(store), create=True)
    tell(f"the store: {made.name}")
    tell(f"use it with `failuretwin diagnose LOG --store {made.name}`")


@store.command()
@store_option
def upgrade(store: str | None) -> None:
    """Bring the tables of an older store up to date. Make a copy first."""
    from failuretwin.data_knowledge.records.database import Database

    database = Database(_url(store))
    before, after = database.upgrade()
    said = "is up to date" if before == after else f"upgraded from revision {before}"
    tell(f"{database.name}: {said} (revision {after})")


@store.command()
@store_option
def check(store: str | None) -> None:
    """Check the database, and that every log is where it was and as it was."""
    opened = ft.open_store(_url(store))
    found = opened.check()
    rows = ", ".join(f"{count} {name}" for name, count in found.rows.items() if count)
    tell(f"{opened.name}: revision {found.revision}; {rows or 'empty'}")
    for problem in found.problems:
        tell(problem)
    if found.problems:
        raise InputError(
            f"{opened.name}: {counted(len(found.problems), 'problem')}. Expected an undamaged "
            "database, and logs as they were; restore them from a copy."
        )
    tell("no problems")


@store.command()
@opt.file_option("--out", "DIR", "Write all tables as parquet to a folder, one file a table.")
@opt.file_option(
    "--aas shell", "FILE.aasx|FILE.json", "Write one robot as an Asset Administration Shell."
)
@click.option("--robot-name", metavar="NAME", help="With --aas: name of the robot.")
@store_option
def export(out: Path | None, shell: Path | None, robot_name: str | None, store: str | None) -> None:
    """Write all tables for pandas, DuckDB and the like, or one robot for asset management."""
    if (out is None) == (shell is None):
        raise click.UsageError("give one of --out DIR and --aas FILE.")
    if (shell is None) != (robot_name is None):
        raise click.UsageError("--aas FILE and --robot-name NAME belong together. Give both.")
    opened = ft.open_store(_url(store))
    if out is not None:
        rows = opened.export(out)
        tell(f"written to {out}: {', '.join(f'{name} ({count})' for name, count in rows.items())}")
    if shell is not None and robot_name is not None:
        tell(f"written to {shell}: {', '.join(opened.export_shell(robot_name, shell))}")


@click.command()
@click.argument("robot")
@opt.report_option("Write the history as a page too.")
@store_option
def history(robot: str, report: Path | None, store: str | None) -> None:
    """Show what a robot went through: episodes, findings, repairs, calibrations, last runs."""
    from failuretwin.app.records import history_parts, write_history_page

    found = ft.open_store(_url(store)).history(robot)
    if report is not None:
        write_history_page(found, report)
        tell(f"the page: {report / 'index.html'}", err=True)
    show(*history_parts(found))


@click.command()
@click.argument("robot")
@click.argument("episode", type=int)
@opt.flag_option("--confirmed", "The motor had this fault.")
@opt.flag_option("--wrong", "The robot was healthy.")
@click.option(
    "--cause",
    default="",
    metavar="TEXT",
    help="The cause that was found. Alone: another cause than the diagnosed fault.",
)
@opt.flag_option("--withdraw", "Take the last finding back.")
@person_option
@note_option
@store_option
def found(
    robot: str,
    episode: int,
    confirmed: bool,
    wrong: bool,
    cause: str,
    withdraw: bool,
    person: str,
    note: str,
    store: str | None,
) -> None:
    """State what a person found about an EPISODE of a ROBOT; `history` lists the episodes."""
    from failuretwin.app.records import episode_line

    if confirmed + wrong + withdraw > 1:
        raise click.UsageError("give one of --confirmed, --wrong and --withdraw.")
    if not (confirmed or wrong or withdraw or cause):
        raise click.UsageError("give one of --confirmed, --wrong, --cause TEXT and --withdraw.")
    opened = ft.open_store(_url(store))
    if withdraw:
        opt.refuse_unused("a finding is taken back", "cause")
        stated = opened.withdraw(robot, episode, person=person, note=note)
    else:
        verdict = "confirmed" if confirmed else "wrong" if wrong else "other cause"
        stated = opened.found(robot, episode, verdict, cause=cause, person=person, note=note)
    standing = stated.finding
    tell(f"{robot}, {episode_line(stated)}")
    tell(f"finding: {standing.verdict if standing else 'none'}")


@click.command()
@click.argument("robot")
@click.argument("motor")
@click.option("--part", default="", metavar="TEXT", help="The part that was replaced.")
@opt.flag_option("--withdraw", "Take the last repair of the motor back.")
@person_option
@note_option
@store_option
def repaired(
    robot: str, motor: str, part: str, withdraw: bool, person: str, note: str, store: str | None
) -> None:
    """State that a MOTOR of a ROBOT was repaired. The next healthy run clears its episode."""
    opened = ft.open_store(_url(store))
    if withdraw:
        opt.refuse_unused("a repair is taken back", "part")
        opened.withdraw_repair(robot, motor, person=person, note=note)
        tell(f"{robot}, {motor}: last repair taken back")
        return
    opened.repaired(robot, motor, part=part, person=person, note=note)
    tell(f"{robot}, {motor}: {f'{part} replaced' if part else 'repaired'}")


@click.command()
@click.argument("name", required=False)
@click.option(
    "--days",
    type=click.FloatRange(min=0.0),
    default=CHECK_DAYS,
    metavar="DAYS",
    help="Time without a run after which a robot is due.",
)
@store_option
def query(name: str | None, days: float, store: str | None) -> None:
    """Answer a ready question about all robots. Without a NAME: list the questions."""
    from failuretwin.app.records import query_table
    from failuretwin.data_knowledge.records.queries import QUESTIONS

    if name is None:
        for question, asked in QUESTIONS.items():
            tell(f"{question:24}{asked.title}")
        return
    answer = ft.open_store(_url(store)).query(name, days)
    show(query_table(answer) if answer.rows else f"{answer.title}\nnone")
