"""`failuretwin import`, `simulate` and `robot`: runs from logs or the twin, robots from URDFs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

import failuretwin as ft
from failuretwin.app.commands import options as opt
from failuretwin.app.commands.store import (
    StoreOptions,
    recorded_option,
    store_option,
    store_options,
)
from failuretwin.app.terminal import progress_bar, show, tell
from failuretwin.core.errors import InputError, counted

if TYPE_CHECKING:
    from failuretwin.data_knowledge.workers import Workforce
    from failuretwin.digital_model.urdf.check import UrdfReport


@click.command("import")
@opt.file_option(
    "--out",
    "FILE",
    "Output: a run set (.nc, .zarr), a published layout (.mat: one file of cells, no ending "
    "for a folder of pairs), or .csv.",
    required=True,
)
@store_options
@recorded_option
@opt.reading_options
@opt.workforce_options("the runs", "the logs")
@opt.robot_options
def import_(
    out: Path,
    memory: StoreOptions,
    recorded: datetime | None,
    reading: opt.LogOptions,
    workforce: Workforce,
    robot: opt.RobotOptions,
) -> None:
    """Read logs and write them as one run set.

    LOG is any input of `diagnose`. With --store the run set is registered, without a diagnosis.
    """
    from failuretwin.data_knowledge.readers.matlab import check_export_suffix, export_runs

    check_export_suffix(out)
    if out.resolve() in [log.resolve() for log in reading.logs]:
        raise InputError(f"{out}: is what is to be read. Give another name to write to.")
    stored = memory.record(robot)
    runs = reading.runs(robot.model, workforce)
    export_runs(runs, out, ft.DigitalTwin(robot.model))
    tell(f"{counted(runs.sizes['run'], 'run')} written to {out}")
    if stored is not None:
        tell(stored.register(out, runs, reading.logs, recorded))


# `failuretwin simulate`: runs made by the twin.


@click.command()
@opt.file_option("--out", "FILE", "Run set to write (.nc or .zarr).")
@click.option(
    "--fleet",
    "robots",
    type=click.IntRange(1, 1_000_000),
    metavar="N",
    help="With --years and --store: simulate the lives of so many robots into the store, a check "
    "run a week, with wear, repairs, payloads, temperature and shifts.",
)
@click.option(
    "--years",
    type=click.FloatRange(0.1, 100.0),
    metavar="Y",
    help="With --fleet: length of the lives, up to today.",
)
@store_option
@opt.count_option("--runs-per-class", 400, "Runs of each hypothesis; the paper has 400.", least=1)
@opt.hypotheses_option(
    "Hypotheses to simulate, such as healthy,motor_2:stuck. Default: the paper's nine classes."
)
@click.option(
    "--engine",
    type=click.Choice(["servo", "physics"]),
    default="servo",
    help="servo: the published servo loops. physics: rigid bodies (MuJoCo) with friction in the "
    "gears and flexible joints.",
)
@click.option(
    "--sensors",
    metavar="KIND,...",
    help="Sensors of the profile to simulate in addition to the tool's position: accelerometer, "
    "gyroscope, orientation, wire.",
)
@opt.file_option(
    "--faults",
    "FILE",
    "Size, onset and growth of faults: a TOML file with a table for each mode, such as "
    "[drift]. Default: the paper's stuck and steady_state_error; the other modes as assumed in "
    "docs/fault_modes.md.",
)
@opt.workforce_options("the runs", "the folder of --out")
@opt.plugin_option
@opt.calibrated_robot_options("none")
def simulate(
    out: Path | None,
    robots: int | None,
    years: float | None,
    store: str | None,
    runs_per_class: int,
    hypotheses: str | None,
    engine: str,
    sensors: str | None,
    faults: Path | None,
    workforce: Workforce,
    robot: opt.RobotOptions,
) -> None:
    """Make labelled runs with the digital twin and write them as a run set.

    To .zarr any number of runs can be written; if that is interrupted, the same command goes on
    with what is missing. Up to a few thousand can be written to .nc.
    """
    from failuretwin.core.hypothesis import paper_hypotheses, parse_hypotheses
    from failuretwin.data_knowledge.resumable import produce
    from failuretwin.data_knowledge.store import check_destination
    from failuretwin.failure_behavior.registry import MODES, load_modes

    if robots is not None or years is not None:
        _simulate_fleet(robots, years, store, workforce, robot)
        return
    if out is None:
        raise InputError("nothing says where to write. Give --out FILE, or --fleet N --years Y.")
    check_destination(out)
    known = robot.known
    names = known.robot.motor_names
    plan = ft.Plan(
        robot=known.robot,
        hypotheses=paper_hypotheses(names)
        if hypotheses is None
        else parse_hypotheses(hypotheses.split(","), names),
        runs_per_class=runs_per_class,
        seed=robot.seed,
        imperfections=known.imperfections,
        engine=engine,
        sensors=[] if sensors is None else [kind.strip() for kind in sensors.split(",")],
        modes=MODES if faults is None else load_modes(faults),
    )
    with progress_bar("simulating", plan.size) as advance:
        produce(plan, out, workforce, advance, tell=lambda text: tell(text, err=True))
    tell(f"{counted(plan.size, 'run')} written to {out}")


LIVES = ("out", "runs_per_class", "hypotheses", "engine", "sensors", "faults")
"""Options of `simulate` that lives do not have."""


def _simulate_fleet(
    robots: int | None,
    years: float | None,
    store: str | None,
    workforce: Workforce,
    robot: opt.RobotOptions,
) -> None:
    from failuretwin.app.simulated_years import Years, last_midnight, write_years

    opt.refuse_unused("lives of robots go into the store", *LIVES)
    if robots is None or years is None or store is None:
        raise InputError("lives need --fleet N, --years Y and --store URL. Give all three.")
    ideal = str(robot.calibration) == "none"  # nobody named one, and ideal robots would not wear
    own = ft.load_calibration(None, robot.robot) if ideal else robot.known
    plan = Years(own, years, last_midnight(), robot.seed)
    with progress_bar("simulating lives", robots) as advance:
        done = write_years(ft.open_store(store), plan, robots, workforce, advance)
    tell(f"written to {store}: {done}")


# `failuretwin robot`: bring a robot of your own, from its URDF.


@dataclass(frozen=True)
class UrdfOptions:
    """Values of `urdf_options`: a URDF and the ends of its chain."""

    path: Path
    base: str | None
    tool: str | None
    sensor_noise: float

    def report(self) -> UrdfReport:
        """Return the contents of the URDF and what is missing."""
        from failuretwin.digital_model.urdf.check import check_urdf

        return check_urdf(self.path, self.base, self.tool, 1e-3 * self.sensor_noise)


urdf_options = opt.gathered(
    UrdfOptions,
    "urdf",
    click.argument("path", type=opt.PATH, metavar="URDF"),
    click.option(
        "--base",
        metavar="LINK",
        help="Link that carries the base frame, any that is fixed to the arm's foot. Default: the "
        "root.",
    ),
    click.option(
        "--sensor-noise",
        type=click.FloatRange(min=0.0),
        default=0.5,
        metavar="MM",
        help="Noise of the tool sensor on each axis [mm]; joints that move the tool by less for "
        "each radian are left out.",
    ),
    click.option(
        "--tool",
        metavar="LINK",
        help="Link whose origin is the tool point. Default: by name (tool0, tcp, end_effector, "
        "...), else the end of the branch with the most moving joints.",
    ),
)


profile_option = opt.file_option("--out", "PROFILE", "Profile to write: .toml.", required=True)


@click.group()
def robot() -> None:
    """Look a URDF over, make a robot profile of it, and fit it to healthy logs."""


@robot.command()
@urdf_options
def check(urdf: UrdfOptions) -> None:
    """Report whether a URDF can be used, which motors move the tool, and what is missing."""
    from failuretwin.app.reports.robot_report import urdf_parts

    report = urdf.report()
    show(*urdf_parts(report))
    report.raise_errors()


@robot.command()
@profile_option
@click.option(
    "--home",
    metavar="ANGLE,...",
    help="Angle of each motor at rest [deg, mm for one that slides], base to tool; random "
    "movements keep round it. Default: the middle of the limits.",
)
@urdf_options
def init(out: Path, home: str | None, urdf: UrdfOptions) -> None:
    """Write a commented profile for the robot of a URDF, ready for --robot PROFILE."""
    from failuretwin.digital_model.profile_text import profile_text

    _check_profile(out)
    report = urdf.report()
    _write_profile(profile_text(report, out, _home(home, report)), out)
    for message in report.having("warning"):
        tell(f"warning: {message}", err=True)
    tell(
        f"profile with {counted(len(report.motors), 'motor')} written to {out}; go through the "
        "lines that say 'assumed'"
    )


def _check_profile(out: Path, replaced: Path | None = None) -> None:
    """Check the name of a profile to write; only the profile `replaced` may be overwritten."""
    if out.suffix != ".toml":
        raise InputError(f"{out}: a profile ends in .toml. Give such a name.")
    if out.exists() and (replaced is None or out.resolve() != replaced.resolve()):
        raise InputError(f"{out}: exists already. Choose another name, or remove it first.")


def _write_profile(text: str, out: Path) -> None:
    """Write a profile that `load_robot` accepts; otherwise nothing is written."""
    from failuretwin.data_knowledge.store import replacing

    with replacing(out) as partial:
        partial.write_text(text, encoding="utf-8")
        ft.load_robot(partial)


def _home(text: str | None, report: UrdfReport) -> list[float]:
    """Return the angles at rest of `--home` [rad or m]; empty if it is not given."""
    if text is None:
        return []
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"--home {text}: expected numbers separated by commas.") from None
    if len(values) != len(report.motors):
        names = ", ".join(motor.joint.name for motor in report.motors)
        raise InputError(
            f"--home {text}: {counted(len(values), 'value')}, expected {len(report.motors)}, "
            f"one for each motor: {names}."
        )
    units = [1e-3 if m.joint.type == "prismatic" else math.pi / 180.0 for m in report.motors]
    return [value * unit for value, unit in zip(values, units, strict=True)]


@robot.command("fit")
@profile_option
@opt.reading_options
@opt.robot_options
def fit_(out: Path, reading: opt.LogOptions, robot: opt.RobotOptions) -> None:
    """Find frames, tool point, senses, zeros and geometry from poses in which a healthy arm rests.

    LOG is any input of `diagnose`. The profile of --robot is written with the fitted values, its
    remarks kept. Forty poses all over the range tell the frames, hundreds the geometry.
    """
    from datetime import UTC, datetime

    from failuretwin.app.reports.robot_report import registration_parts
    from failuretwin.connection.registration.fit import fit_registration
    from failuretwin.digital_model.profile_text import fitted_text

    model = robot.model
    _check_profile(out, model.source)
    runs = reading.runs(model)
    names = ", ".join(log.name for log in reading.logs)
    found = fit_registration(runs, model, names, datetime.now(UTC).date().isoformat())
    text = fitted_text(model.source.read_text(encoding="utf-8"), model.source, out, found.profile)
    _write_profile(text, out)
    show(*registration_parts(found))
    tell(f"written to {out}; use it with --robot {out}")
