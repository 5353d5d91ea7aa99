"""`failuretwin diagnose`: which motor failed, how, since when and how surely."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import (
    PATH,
    HypothesesOption,
    LogOptions,
    common_options,
    plugin_option,
    reading_options,
)


@click.command()
@click.argument("inputs", nargs=-1, required=True, type=PATH, metavar="INPUT...")
@click.option(
    "--calibration",
    type=PATH,
    metavar="FILE",
    help="What `calibrate` learned of this robot. Default: the calibration its profile names.",
)
@click.option(
    "--method",
    default="bayes",
    show_default=True,
    metavar="bayes|MODEL|bayes+MODEL",
    help="How to diagnose: by Bayes' rule, by a network that `train` wrote, or by both.",
)
@click.option(
    "--track",
    is_flag=True,
    help="Follow the wear of the robot from run to run, and keep its history beside the "
    "calibration (FILE.history.jsonl). Give runs in their order, the oldest first.",
)
@click.option(
    "--hypotheses",
    cls=HypothesesOption,
    metavar="H,...",
    help="What may be the case, two at least: healthy, MOTOR:MODE, two of these joined by '+', "
    "unknown. Such as healthy,motor_2:stuck. Default: the paper's nine classes.",
)
@click.option(
    "--sse-range",
    nargs=2,
    type=float,
    metavar="LOW HIGH",
    help="Known range of steady-state errors [servo units]. Default: several, weighed.",
)
@click.option("--onset", type=float, metavar="SECONDS", help="Onset of stuck faults, where known.")
@click.option("--json", "json_file", type=PATH, help="Write an object a line, a line a run.")
@click.option("--csv", "csv_file", type=PATH, help="Write a table, a row a run.")
@click.option(
    "--plot",
    type=PATH,
    metavar="DIR",
    help="Write a picture of each run, and index.html with all of them.",
)
@reading_options
@plugin_option
@common_options
def diagnose(
    inputs: tuple[Path, ...],
    calibration: Path | None,
    method: str,
    track: bool,
    hypotheses: str | None,
    sse_range: tuple[float, float] | None,
    onset: float | None,
    json_file: Path | None,
    csv_file: Path | None,
    plot: Path | None,
    reading: LogOptions,
    robot: str,
    seed: int,
) -> None:
    """Diagnose runs from commands and tool path alone.

    INPUT is a run set (.nc, .zarr), a folder with raw sessions or published MATLAB files (searched
    downwards), such a file (.mat), a bag (.bag, .mcap), or a CSV file with --columns.
    """
    del seed  # nothing here is drawn by chance
    from failuretwin.app.inputs import (
        chosen_diagnoser,
        expected_name,
        read_inputs,
        tell_mismatch,
        told_hypotheses,
    )
    from failuretwin.app.tables import (
        ambiguity_lines,
        print_diagnoses,
        print_lines,
        print_scores,
        progress_bar,
    )
    from failuretwin.connection.tracking import (
        diagnose_tracked,
        keep_history,
        open_history,
        tracking_line,
    )
    from failuretwin.decision.results import write_csv, write_json_lines
    from failuretwin.digital_model.nonidealities import load_imperfections
    from failuretwin.digital_model.robot import load_robot
    from failuretwin.digital_model.twin import DigitalTwin
    from failuretwin.inference.diagnoser import BayesDiagnoser
    from failuretwin.inference.priors import priors_of

    model = load_robot(robot)
    twin = DigitalTwin(model)
    bayes = BayesDiagnoser(
        twin,
        imperfections=None if calibration is None else load_imperfections(str(calibration), model),
        hypotheses=told_hypotheses(hypotheses, model),
        priors=priors_of(model, sse_range, onset),
    )
    settings = {
        "--calibration": calibration,
        "--track": track or None,
        "--hypotheses": hypotheses,
        "--sse-range": sse_range,
        "--onset": onset,
    }
    diagnoser = chosen_diagnoser(method, bayes, settings)
    history = open_history(bayes, calibration) if track else None
    runs = read_inputs(inputs, model, reading)
    tell_mismatch(runs, expected_name(diagnoser, bayes))
    tracked = None
    if history is not None:
        with progress_bar("diagnosing", runs.sizes["run"]) as advance:
            tracked = diagnose_tracked(runs, bayes, history, advance)
    diagnoses = diagnoser.diagnose(runs) if tracked is None else tracked.diagnoses
    records = [diagnosis.to_record() for diagnosis in diagnoses]
    if json_file is not None:
        write_json_lines(records, json_file)
    if csv_file is not None:
        write_csv(records, csv_file)
    if plot is not None:
        from failuretwin.app.plots import plot_runs, write_page
        from failuretwin.data_knowledge.store import filling

        with filling(plot) as folder:
            pictures = plot_runs(runs, diagnoses, twin, folder)
            write_page(diagnoses, pictures, model.name, folder / "index.html")
    if tracked is not None:
        keep_history(tracked)
    print_diagnoses(diagnoses)
    if method == "bayes":
        print_lines(ambiguity_lines(runs, bayes))
    print_scores(records)
    if tracked is not None:
        click.echo(f"\n{tracking_line(tracked)}")
