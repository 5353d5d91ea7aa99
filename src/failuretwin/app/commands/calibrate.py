"""`failuretwin calibrate`: a twin that knows this very robot, from its healthy logs."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import PATH, LogOptions, common_options, reading_options


@click.command()
@click.argument("logs", nargs=-1, required=True, type=PATH, metavar="LOG...")
@click.option("--out", required=True, type=PATH, help="Calibration to write (.toml).")
@click.option(
    "--hold-out",
    metavar="SESSION",
    help="Learn nothing from sessions with this in their name; only see how well they are "
    "predicted. Default: each session is left out once, and the result learns from all.",
)
@click.option("--name", help="What results call the calibration. Default: the file's name.")
@click.option("--report", type=PATH, metavar="DIR", help="Write a page with tables and pictures.")
@reading_options
@common_options
def calibrate(
    logs: tuple[Path, ...],
    out: Path,
    hold_out: str | None,
    name: str | None,
    report: Path | None,
    reading: LogOptions,
    robot: str,
    seed: int,
) -> None:
    """Learn from healthy logs where the motors settle, how they lag and what goes wrong by chance.

    LOG is whatever `diagnose` reads. Motor readings are used where the logs have them, else the
    tool path alone. Runs that are labelled or look faulty are left out. Step tests (CSV files, or
    folders that hold some) add servo loops and speed limits.
    """
    del seed  # nothing here depends on chance
    from failuretwin.app.calibration_tables import beats_uncalibrated, print_calibration
    from failuretwin.app.inputs import learn_loops, read_inputs, split_step_tests, with_step_tests
    from failuretwin.connection.calibration.calibrate import calibrate as learn
    from failuretwin.connection.calibration.result import check_calibration_file, save_calibration
    from failuretwin.digital_model.robot import load_robot

    check_calibration_file(out)
    tests, others = split_step_tests(logs, reading.columns)
    steps = learn_loops(tests, load_robot(robot))
    model = steps.robot
    runs = read_inputs(others, model, reading)
    source = ", ".join(str(log) for log in logs)
    found = learn(runs, model, name or out.stem, source, hold_out)
    found = with_step_tests(found, steps)
    if report is not None:
        from failuretwin.app.calibration_report import write_calibration_page
        from failuretwin.data_knowledge.store import filling

        with filling(report) as folder:
            write_calibration_page(found, runs, model, folder)
    save_calibration(found, model, out)
    print_calibration(found, model)
    click.echo(f"written to {out}")
    if beats_uncalibrated(found):
        click.echo(f"use it with `failuretwin diagnose --calibration {out}`")
