"""What a stranger meets at the benchmark: wrong entries, changed files, other people's results."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from failuretwin.app.cli import cli
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.store import load_run_set, save_run_set
from failuretwin.decision.benchmark import real, runner
from failuretwin.decision.benchmark.simulated import load_set

ENTRIES = """
import numpy as np


class Equal:
    answer = np.array([[0.5, 0.5]])

    def fit(self, X, y):
        self.classes_ = np.array(["healthy", "motor_2:stuck"])

    def predict_proba(self, X):
        return np.repeat(self.answer, len(X), axis=0)


class Argument(Equal):
    def __init__(self, depth):
        self.depth = depth


class Logarithm(Equal):
    answer = np.log([[0.5, 0.5]])


class Broken(Equal):
    answer = np.array([[np.nan, np.nan]])


class Three(Equal):
    answer = np.full((1, 3), 1 / 3)


class Numbered(Equal):
    def fit(self, X, y):
        self.classes_ = np.array([0, 1])


class Unclassed(Equal):
    def fit(self, X, y):
        return self


class Hard:
    def fit(self, X, y):
        return self

    def predict(self, X):
        return ["healthy"] * len(X)


class Untrained:
    def predict_proba(self, X):
        return X


class Reader:
    def __init__(self, twin):
        self.seen = []

    def fit(self, runs):
        pass

    def diagnose(self, runs):
        from failuretwin import Diagnosis

        names = [str(name) for name in runs["run"].values]
        with open("seen.txt", "a") as file:
            file.write(f"{names} {list(runs.variables)} {runs.attrs}")
        return [Diagnosis(name, {"healthy": 1.0}) for name in names]
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A data folder that the tests of this file share."""
    return tmp_path_factory.mktemp("data")


@pytest.fixture
def entries(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("strange_entries.py").write_text(ENTRIES)
    yield
    sys.modules.pop("strange_entries", None)


def bench(words):
    return CliRunner().invoke(cli, ["benchmark", *map(str, words)])


def run(method, data, out="out", tasks="set_up"):
    part = ["--tasks", tasks, "--arms", "armpi_fpv", "--tracks", "P0", "--data", data]
    return bench(["run", "--method", method, "--out", out, *part])


@pytest.mark.parametrize(
    ("name", "got", "fix"),
    [
        ("Argument", "missing 1 required positional argument: 'depth'", "Expected a default for"),
        ("Logarithm", "'healthy': -0.69", "probabilities from 0 to 1 that sum to 1"),
        ("Broken", "'healthy': nan", "probabilities from 0 to 1 that sum to 1"),
        ("Three", "gave shape (36, 3)", "(36, 2)"),
        ("Numbered", "unknown label '0'", "Valid: healthy, motor_1:stuck"),
        ("Unclassed", "has no `classes_`", "Expected the labels of y"),
        ("Hard", "neither `predict_proba` nor `diagnose`", "CalibratedClassifierCV"),
        ("Untrained", "has no method `fit`", "Expected fit(X, y)"),
    ],
)
def test_a_wrong_entry_is_refused_and_leaves_nothing(name, got, fix, entries, data):
    error = run(f"strange_entries:{name}", data).exception
    assert isinstance(error, InputError)
    assert str(error).startswith(f"strange_entries:{name}: ")
    assert got in str(error) and fix in str(error)
    assert not Path("out").exists()


def test_kept_answers_are_announced(entries, data):
    assert "kept" not in run("strange_entries:Equal", data).output
    assert "note: 1 answered case of out kept" in run("strange_entries:Equal", data).output


def test_a_later_part_keeps_the_scores_of_earlier_ones(entries, data):
    run("strange_entries:Equal", data)
    run("strange_entries:Equal", data, tasks="cold")
    scores = json.loads(Path("out", runner.RESULTS).read_text())["scores"]
    assert {score["task"] for score in scores} == {"set_up", "cold"}


# Results of other people.


@pytest.fixture
def submission(entries, data):
    run("strange_entries:Equal", data)
    words = ["submit-file", "out", "--name", "Equal", "--out", "equal.json", "--data", data]
    assert bench(words).exit_code == 0
    return json.loads(Path("equal.json").read_text())


def page_of(stored, data):
    Path("other.json").write_text(json.dumps(stored))
    found = bench(["page", "other.json", "--out", "page", "--data", data])
    if found.exception:
        raise found.exception
    return Path("page/index.html").read_text()


def test_a_forged_score_does_not_reach_the_page(submission, data):
    honest = page_of(submission, data)
    for score in submission["scores"]:
        score |= {"value": 98.765, "low": 98.0, "high": 99.0}
    assert page_of(submission, data) == honest


def test_names_in_files_are_text_and_not_paths_or_markup(submission, data):
    assert "<script>alert" not in page_of(submission | {"name": "<script>alert(1)"}, data)
    texts = {"../../armpi_fpv-mistaken-P0.jsonl": next(iter(submission["texts"].values()))}
    with pytest.raises(InputError, match=r"other\.json: answers: unknown arm"):
        page_of(submission | {"texts": texts}, data)


def test_answers_to_some_runs_are_no_answers(submission, data):
    texts = {name: text.partition("\n")[0] for name, text in submission["texts"].items()}
    with pytest.raises(InputError, match="holds 1 answer, and none to 35 of the 36 runs"):
        page_of(submission | {"texts": texts}, data)


def test_a_missing_folder_of_results_is_named(tmp_path):
    words = ["submit-file", tmp_path / "no", "--name", "x", "--out", tmp_path / "x.json"]
    assert "no: has no results.json. Expected the --out of" in str(bench(words).exception)


# Data that were changed.


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda runs: runs.assign_attrs(measured_rate_hz=100.0), "attributes"),
        (lambda runs: runs.assign_attrs(individual="b"), "attributes"),
        (lambda runs: runs.assign(position=runs["command"]), "variables"),
        (lambda runs: runs.assign(duration=runs["duration"] * 0.5), "checksum"),
        (lambda runs: runs.assign(magnitude=runs["magnitude"] * 2.0), "checksum"),
    ],
)
def test_any_change_of_a_data_file_is_refused(change, named, entries, data, tmp_path):
    run("chance", data, "first")
    place = "simulated/armpi_fpv/mistaken.nc"
    changed = tmp_path / "changed" / place
    changed.parent.mkdir(parents=True)
    save_run_set(change(load_run_set(data / place).load()), changed)
    error = run("chance", tmp_path / "changed").exception
    assert isinstance(error, InputError)
    assert f"mistaken.nc: has {named}" in str(error) and "Remove it" in str(error)


def test_a_damaged_data_file_is_refused(entries, data, tmp_path):
    place = "simulated/armpi_fpv/mistaken.nc"
    run("chance", data, "first")
    damaged = tmp_path / "damaged" / place
    damaged.parent.mkdir(parents=True)
    damaged.write_bytes((data / place).read_bytes()[:-1000])
    error = run("chance", tmp_path / "damaged").exception
    assert isinstance(error, InputError)
    assert "mistaken.nc: cannot be read" in str(error) and "Remove it" in str(error)


def test_changes_below_the_resolution_of_the_data_do_not_reach_a_method(entries, data, tmp_path):
    place = "simulated/armpi_fpv/mistaken.nc"
    run("chance", data, "first")
    moved = tmp_path / place
    moved.parent.mkdir(parents=True)
    runs = load_run_set(data / place)
    save_run_set(runs.assign(measured=runs["measured"] + 1e-6), moved)
    assert load_set("armpi_fpv", "mistaken", tmp_path).identical(
        load_set("armpi_fpv", "mistaken", data)
    )


def test_simulated_sets_have_no_copy(tmp_path):
    words = ["data", "fetch", "simulated", "--from", str(tmp_path)]
    assert "leave out --from" in str(CliRunner().invoke(cli, words).exception)


@pytest.fixture
def recorded(write_session, monkeypatch, tmp_path):
    """A published set of three sessions, one stuck, one with errors; its folder in `d`."""
    for label in (0, 2, 5):
        write_session(tmp_path / "d" / runner.REAL / f"label_{label}" / f"day_label_{label}", 10.0)
    folder = tmp_path / "d" / runner.REAL
    hashes = {
        str(file.relative_to(folder)): real.sha256(file.read_bytes())
        for file in sorted(folder.rglob("*.csv"))
    }
    one = real.RealSet("x", "owner/name", "0" * 40, "", "MIT", hashes)
    monkeypatch.setattr(real, "real_sets", lambda: {runner.REAL: one})
    return folder


def test_other_folders_beside_a_recorded_set_do_not_count(recorded, write_session, entries):
    before = run("chance", recorded.parent, tasks="real").output
    write_session(recorded / "label_1" / "mine_label_1")
    assert run("chance", recorded.parent, "again", tasks="real").output == before.replace(
        "out/", "again/"
    )


def test_names_of_recorded_runs_hide_their_labels(recorded, entries):
    assert run("strange_entries:Reader", recorded.parent, tasks="real").exit_code == 0
    seen = Path("seen.txt").read_text()
    assert "armpi_fpv-real-0000" in seen
    assert "label_" not in seen and "day" not in seen and "fault" not in seen


@pytest.mark.parametrize("bytes_kept", [0, 40, 300])
def test_a_broken_download_is_refused(bytes_kept, tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "a.csv").write_bytes(rng.bytes(2000))
    with tarfile.open(tmp_path / "a.tar.gz", "w:gz") as archive:
        archive.add(tmp_path / "a.csv", "a.csv")
    broken = tmp_path / "broken.tar.gz"
    broken.write_bytes((tmp_path / "a.tar.gz").read_bytes()[:bytes_kept])
    words = ["data", "fetch", runner.REAL, "--from", str(broken), "--data", str(tmp_path / "d")]
    error = CliRunner().invoke(cli, words).exception
    assert isinstance(error, InputError)
    assert "cannot be read as .tar.gz" in str(error) and "Fetch it again" in str(error)


MAIN = "from failuretwin.app.cli import main; main()"


def test_scores_do_not_depend_on_threads(data, tmp_path):
    answers = []
    for threads in ("1", "2"):
        out = tmp_path / threads
        part = f"--tasks set_up --arms armpi_fpv --tracks P0 --data {data} --out {out}"
        words = f"benchmark run --method kalman {part}".split()
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
        environment = os.environ | dict.fromkeys(names, threads) | {"PYTHONHASHSEED": threads}
        subprocess.run([sys.executable, "-c", MAIN, *words], env=environment, check=True)
        answers.append(json.loads((out / runner.RESULTS).read_text()))
    one, two = answers
    assert one["scores"] and one["scores"] == two["scores"]
    assert one["answers"] == two["answers"]
