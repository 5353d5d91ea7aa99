from __future__ import annotations

import json
import re

import numpy as np
import pandas as pd
import pytest

import failuretwin as package
from failuretwin.app.cli import cli
from failuretwin.connection.links import NETWORKS
from failuretwin.data_knowledge.store import load_run_set, save_run_set
from failuretwin.decision.streaming import STREAMED
from warm_command import remarks

CONTRACT = {
    "run",
    "truth",
    "diagnosis",
    "probability",
    "posterior",
    "runner_up",
    "onset_s",
    "onset_90",
    "magnitude",
    "magnitude_unit",
    "magnitude_90",
    "verdict",
    "quality",
    "protocol",
    "method",
}
FEW = ("--hypotheses", "healthy,motor_1:stuck,motor_2:stuck")
BEYOND_IT = {"state", "explanation", "evidence"}
"""What a result may say on top of the contract."""
ANSI = "\x1b"
MANY = ("stuck", "drift", "encoder_bias", "encoder_scale", "torque_loss")


def no_constant(name):
    raise ValueError(f"{name} is no JSON")


def read_lines(path):
    return [json.loads(line, parse_constant=no_constant) for line in path.read_text().splitlines()]


def score_lines(text):
    """Return what the output says after the table of runs."""
    return text[re.search(r"\d+ of \d+ runs right", text).start() :].splitlines()


def begins_with(lines, first):
    return len(first) > 0 and lines[: len(first)] == first


@pytest.fixture(scope="module")
def results(failuretwin, simulated, tmp_path_factory):
    """Everything that `diagnose` says of the simulated runs."""
    folder = tmp_path_factory.mktemp("results")
    answer = failuretwin(
        "diagnose", simulated, "--json", folder / "x.jsonl", "--csv", folder / "x.csv"
    )
    assert answer.returncode == 0, answer.stderr
    return answer, read_lines(folder / "x.jsonl"), folder


def test_demo_diagnoses_the_runs_that_come_with_the_package(failuretwin):
    told = failuretwin("demo").stdout
    assert re.search(r"run_1 +healthy, ", told)
    assert re.search(r"run_2 +motor 3 stuck at -7 deg since 0.5 s, ", told)
    assert re.search(r"run_3 +motor 2 misses its targets by about 7.2 deg, ", told)


def test_version_and_help(failuretwin):
    assert package.__version__ in failuretwin("--version").stdout
    text = failuretwin("--help").stdout
    for verb in ("import", "simulate", "diagnose", "evaluate"):
        assert re.search(rf"^  {verb}\s", text, re.MULTILINE)


def test_options_take_the_names_of_the_networks_and_of_the_streams():
    options = {
        (verb, option.opts[0]): option
        for verb in ("act", "check", "stop", "emulate", "watch")
        for option in cli.commands[verb].params
    }
    places = [options[verb, "--on"] for verb in ("act", "check", "stop")]
    for option in (*places, options["emulate", "--to"]):
        assert set(NETWORKS) <= set(option.metavar.split("|"))
    assert tuple(options["watch", "--sensing"].type.choices) == STREAMED


OWN_SHAPE = {"--fault", "--fleet", "--on", "--out", "--sensing"}
"""Options that mean something else in each command."""


def test_an_option_of_several_commands_has_one_shape():
    shapes = {}
    for verb, command in cli.commands.items():
        for option in command.params:
            if option.opts[0] not in OWN_SHAPE:
                shape = type(option.type), option.metavar, option.multiple, option.name
                shapes.setdefault(option.opts[0], {}).setdefault(shape, []).append(verb)
    several = {flag: found for flag, found in shapes.items() if len(found) > 1}
    assert list(several) == ["source", "task"]


@pytest.mark.parametrize("verb", ["reach", "check", "isolability"])
@pytest.mark.parametrize("option", ["--json", "--report"])
def test_an_output_that_cannot_be_written_is_refused_before_any_work(
    failuretwin, tmp_path, verb, option
):
    (tmp_path / "file").write_text("")
    place = "no/such/file" if option == "--json" else "file"
    arguments = ("no_task.csv",) if verb == "reach" else ("--motions", "no_motions.json")
    answer = failuretwin(verb, *arguments, option, place, folder=tmp_path)
    assert answer.returncode == 2
    assert place in answer.stderr
    assert "no_" not in answer.stderr


def test_a_line_a_run_with_the_keys_of_the_contract(results, simulated):
    _, records, _ = results
    assert [r["run"] for r in records] == load_run_set(simulated)["run"].values.tolist()
    for record in records:
        assert record.keys() - BEYOND_IT == CONTRACT
        assert sum(record["posterior"].values()) == pytest.approx(1.0, abs=1e-9)
        assert len(record["posterior"]) == 9
        if record["diagnosis"] is not None:
            best = max(record["posterior"], key=record["posterior"].get)
            assert record["diagnosis"] == best
            assert record["probability"] == record["posterior"][best]


def test_what_is_not_known_is_null(failuretwin, simulated, tmp_path, results):
    healthy = next(r for r in results[1] if r["diagnosis"] == "healthy")
    for key in ("onset_s", "onset_90", "magnitude", "magnitude_unit", "magnitude_90"):
        assert healthy[key] is None
    blind = load_run_set(simulated).isel(run=[0]).drop_vars(["fault", "onset", "magnitude"])
    save_run_set(blind.assign(measured=blind["measured"] * float("nan")), tmp_path / "blind.nc")
    failuretwin("diagnose", "blind.nc", *FEW, "--json", "blind.jsonl", folder=tmp_path)
    (record,) = read_lines(tmp_path / "blind.jsonl")
    assert record["truth"] is None
    assert record["verdict"].startswith("cannot tell, because ")


def test_csv_has_a_row_a_run(results):
    _, records, folder = results
    table = pd.read_csv(folder / "x.csv")
    assert len(table) == 9
    assert table["run"].tolist() == [r["run"] for r in records]
    for column, name in (("p(healthy)", "healthy"), ("p(motor_2:stuck)", "motor_2:stuck")):
        expected = [r["posterior"][name] for r in records]
        assert table[column].tolist() == pytest.approx(expected)
    assert table["diagnosis"].dropna().tolist() == [
        r["diagnosis"] for r in records if r["diagnosis"]
    ]
    sizes = [r["magnitude"] for r in records if r["magnitude"] is not None]
    assert table["magnitude"].dropna().tolist() == pytest.approx(sizes)


def test_table_says_right_and_wrong_and_how_often(results):
    answer, records, _ = results
    right = sum(r["truth"] == r["diagnosis"] for r in records)
    assert len(re.findall(r"\bright\b", answer.stdout)) - 1 == right
    assert len(re.findall(r"\bWRONG\b", answer.stdout)) == 9 - right
    accuracy = rf"{right} of 9 runs right: accuracy {100 * right / 9:.1f} % \(95 % interval"
    assert re.search(accuracy, answer.stdout)
    for word in ("precision", "recall", "F1", "confusion matrix", "protocol P0c", "log score"):
        assert word in answer.stdout


def test_what_such_motions_show_is_told(results, failuretwin, simulated, tmp_path):
    answer, _, _ = results
    (line,) = [row for row in answer.stdout.splitlines() if row.startswith("smallest faults")]
    sizes = re.findall(r"motor (\d) misses its targets by about (\d+\.\d) deg", line)
    assert [motor for motor, _ in sizes] == ["1", "2", "3", "4"]
    assert all(0.3 < float(size) < 10.0 for _, size in sizes)
    assert "cannot be told apart by such motions" not in answer.stdout

    alike = "healthy,motor_2:encoder_scale,motor_2:torque_loss,motor_1:torque_loss"
    save_run_set(load_run_set(simulated).isel(run=[0]), tmp_path / "run.nc")
    said = failuretwin("diagnose", "run.nc", "--hypotheses", alike, folder=tmp_path).stdout
    (line,) = [row for row in said.splitlines() if row.startswith("cannot be told apart")]
    head, _, told = line.partition(": ")
    assert head == "cannot be told apart by such motions when faults are as large as this"
    groups = told.split("; ")
    # the sizes are those between the least and the most that diagnosis considers
    assert any(row.startswith("healthy or ") and "motor 1 weak by 45 %" in row for row in groups)
    assert "motor 2 has a wrong scale by 15 % or motor 2 weak by 45 %" in groups
    assert "not shown for certain, even when as large as this: motor 1 weak by 80 %" in said
    assert "something is wrong shows" not in said


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (
            "healthy,unknown,motor_1:stuck+motor_2:stuck",
            "said of single faults only, not of 1 pair of faults and unknown",
        ),
        (
            ",".join(f"motor_{k}:{m}" for k in (1, 2, 3, 4) for m in MANY),
            "which of these 20 hypotheses such motions tell apart may take longer to work "
            "out than the diagnosis (done for up to 16): call failuretwin.isolability in Python",
        ),
    ],
    ids=["no single fault", "many"],
)
def test_what_is_not_compared_is_said(failuretwin, simulated, tmp_path, names, words):
    save_run_set(load_run_set(simulated).isel(run=[0]), tmp_path / "run.nc")
    said = failuretwin("diagnose", "run.nc", "--hypotheses", names, folder=tmp_path).stdout
    assert words in said


@pytest.mark.parametrize("range_counts", [(0, 10), (10, 1000)])
def test_errors_of_any_size_that_a_motor_can_have_may_be_told(
    failuretwin, simulated, tmp_path, range_counts
):
    save_run_set(load_run_set(simulated).isel(run=[0]), tmp_path / "run.nc")
    among = ("--hypotheses", "healthy,motor_1:steady_state_error")
    options = ("--sse-range", *range_counts, *among)
    answer = failuretwin("diagnose", "run.nc", *options, folder=tmp_path)
    assert answer.returncode == 0, answer.stderr
    assert "misses its targets" in answer.stdout


def test_wrong_diagnoses_are_marked(failuretwin, simulated, tmp_path):
    runs = load_run_set(simulated).isel(run=[1, 2])
    save_run_set(runs.assign(fault=("run", runs["fault"].values[::-1])), tmp_path / "lies.nc")
    answer = failuretwin("diagnose", "lies.nc", *FEW, folder=tmp_path)
    assert answer.stdout.count("WRONG") == 2
    assert "0 of 2 runs right: accuracy 0.0 %" in answer.stdout


def test_a_fault_that_is_not_named_is_rightly_called_unknown(failuretwin, simulated, tmp_path):
    save_run_set(load_run_set(simulated).isel(run=[2]), tmp_path / "one.nc")
    arguments = ("one.nc", "--hypotheses", "healthy,motor_1:stuck,unknown", "--report", "page")
    answer = failuretwin("diagnose", *arguments, folder=tmp_path)
    assert "WRONG" not in answer.stdout
    assert re.search("1 of 1 runs? right", answer.stdout)
    line = "judged as unknown, since not among the hypotheses: motor_2:stuck (1 run)"
    assert line in answer.stdout.splitlines()
    page = (tmp_path / "page" / "index.html").read_text()
    assert line in page
    assert 'class="wrong"' not in page


def test_without_truth_there_is_nothing_to_score(failuretwin, simulated, tmp_path):
    runs = load_run_set(simulated).isel(run=[0, 2])
    save_run_set(runs.drop_vars("fault"), tmp_path / "runs.nc")
    answer = failuretwin("diagnose", "runs.nc", *FEW, folder=tmp_path)
    assert answer.returncode == 0
    for word in ("right", "WRONG", "accuracy", "confusion"):
        assert word not in answer.stdout


def test_evaluate_says_what_diagnose_said(failuretwin, results):
    answer, _, folder = results
    again = failuretwin("evaluate", folder / "x.jsonl")
    assert again.returncode == 0, again.stderr
    assert begins_with(score_lines(again.stdout), score_lines(answer.stdout))


def test_truth_may_come_from_a_run_set(failuretwin, results, simulated, tmp_path):
    answer, records, _ = results
    untold = [json.dumps({**r, "truth": None}) + "\n" for r in records]
    (tmp_path / "untold.jsonl").write_text("".join(untold))
    alone = failuretwin("evaluate", "untold.jsonl", folder=tmp_path)
    assert alone.returncode == 2
    assert "--truth" in alone.stderr
    told = failuretwin("evaluate", "untold.jsonl", "--truth", simulated, folder=tmp_path)
    assert begins_with(score_lines(told.stdout), score_lines(answer.stdout))


@pytest.mark.parametrize(("how", "suffix"), [("measured", ".nc"), ("published", ".zarr")])
def test_imported_sessions_give_the_same_results(failuretwin, write_session, tmp_path, how, suffix):
    write_session(tmp_path / "logs" / "20240101_label_0", seed=1)
    write_session(tmp_path / "logs" / "20240102_label_3", seed=2)
    options = ["--as", how, "--published-labels"]
    among = ["--hypotheses", "healthy,motor_3:stuck,motor_3:steady_state_error"]
    runs = f"runs{suffix}"

    imported = failuretwin("import", "logs", "--out", runs, *options, folder=tmp_path)
    assert imported.stdout == f"2 runs written to {runs}\n"
    stored = failuretwin("diagnose", runs, *among, "--json", "stored.jsonl", folder=tmp_path)
    direct = failuretwin(
        "diagnose", "logs", *options, *among, "--json", "direct.jsonl", folder=tmp_path
    )

    assert stored.returncode == direct.returncode == 0, stored.stderr + direct.stderr
    records = read_lines(tmp_path / "direct.jsonl")
    assert [r["truth"] for r in records] == ["healthy", "motor_3:stuck"]
    assert read_lines(tmp_path / "stored.jsonl") == records
    assert stored.stdout == direct.stdout
    scores = failuretwin("evaluate", "stored.jsonl", folder=tmp_path)
    assert begins_with(score_lines(scores.stdout), score_lines(direct.stdout))


def test_faults_come_as_large_as_the_file_says(failuretwin, tmp_path):
    (tmp_path / "faults.toml").write_text("[drift]\nmagnitude = [0.02, 0.02]\nonset_s = [3, 3]\n")
    answer = failuretwin(
        *("simulate", "--out", "x.nc", "--runs-per-class", 2, "--faults", "faults.toml"),
        *("--hypotheses", "motor_1:stuck,motor_2:drift", "--seed", 3),
        folder=tmp_path,
    )
    assert answer.returncode == 0, answer.stderr
    runs = load_run_set(tmp_path / "x.nc")
    assert runs.attrs["seed"] == 3
    np.testing.assert_allclose(runs["onset"], [0.49, 0.49, 3.0, 3.0])
    np.testing.assert_allclose(np.abs(runs["magnitude"][2:]), 0.02)
    modes = json.loads(runs.attrs["configuration"])["modes"]
    assert modes["drift"]["magnitude"] == [0.02, 0.02]


def test_a_picture_for_every_run_and_a_page_that_says_what_the_screen_says(
    failuretwin, simulated, tmp_path
):
    runs = load_run_set(simulated).isel(run=[0, 1])
    names = ["a/b", "a b"]
    save_run_set(runs.assign_coords(run=names), tmp_path / "runs.nc")
    answer = failuretwin("diagnose", "runs.nc", *FEW, "--report", "x/pictures", folder=tmp_path)
    assert answer.returncode == 0, answer.stderr
    pictures = list((tmp_path / "x" / "pictures").glob("*.png"))
    assert len(pictures) == 2
    for picture in pictures:
        assert picture.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
        assert picture.stat().st_size > 10_000
    assert list(tmp_path.rglob("*partial*")) == []
    page = (tmp_path / "x" / "pictures" / "index.html").read_text("utf-8")
    (step,) = re.findall(r"^what to do: (.*)$", answer.stdout, re.M)
    (line,) = re.findall(r"^over all runs: (.*)$", answer.stdout, re.M)
    assert f"<b>Next step:</b> {step}</p>" in page
    assert f"<h1>{re.split('[:;]', line)[0]}" in page


def test_without_a_terminal_there_is_neither_colour_nor_progress(results):
    answer, _, _ = results
    assert ANSI not in answer.stdout
    assert remarks(answer.stderr) == ""
    widest = max(map(len, answer.stdout.splitlines()))
    assert widest > 100, "sentences are cut to the width of a terminal that is not there"


def test_output_may_be_cut_off_by_the_next_command(begin, simulated):
    """As in `failuretwin diagnose RUNS | head -1`."""
    with begin("diagnose", simulated, "--hypotheses", "healthy") as answer:
        answer.stdout.close()
        errors = answer.stderr.read()
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    ("verb", "old", "new"),
    [("simulate", "--imperfections", "--calibration"), ("diagnose", "--plot", "--report")],
)
def test_old_names_of_options_work_and_are_not_shown(failuretwin, verb, old, new):
    shown = failuretwin(verb, "--help").stdout
    assert new in shown
    assert old not in shown
    refused = failuretwin(verb, "--out", "runs.txt", old, "nothing/there", "nothing.nc")
    assert refused.returncode == 2
    assert "No such option" not in refused.stderr
