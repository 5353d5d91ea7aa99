"""The benchmark: data that cannot be changed unnoticed, entries that see no truth, known scores."""

from __future__ import annotations

import hashlib
import json
import tarfile

import numpy as np
import pytest
from scipy.stats import binom

from failuretwin.app.reports.benchmark_page import figure
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.decision.benchmark import real, runner, simulated, tasks
from failuretwin.decision.benchmark.entries import (
    Classifier,
    NotEnteredError,
    entry_of,
    named_runs,
)
from failuretwin.decision.evaluation import RunTruth, Truths
from failuretwin.digital_model.twin import DigitalTwin


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return tmp_path_factory.mktemp("data")


@pytest.mark.parametrize("arm", simulated.ARMS)
@pytest.mark.parametrize("name", ["healthy", "labelled", "mistaken"])
def test_data_are_the_official_ones(arm, name):
    assert (
        simulated.checksum(simulated.make_set(arm, name)) == simulated.official()[f"{arm}/{name}"]
    )


def test_every_set_has_a_checksum():
    names = {f"{arm}/{name}" for arm in simulated.ARMS for name in simulated.SETS}
    assert set(simulated.official()) == names


def test_a_checksum_ignores_the_last_digit_and_nothing_else():
    runs = simulated.make_set("armpi_fpv", "healthy")
    expected = simulated.checksum(runs)
    shaken = runs.assign(measured=runs["measured"] * (1.0 + 1e-14))
    assert simulated.checksum(shaken) == expected
    for name, step in {"measured": 1e-5, "command": 1e-6}.items():
        other = runs.copy(deep=True)
        place = np.argwhere(np.isfinite(other[name].values))[0]
        other[name].values[tuple(place)] += step
        assert simulated.checksum(other) != expected
    truth = runs["fault"].values.copy()
    truth[0] = "motor_1:stuck"
    assert simulated.checksum(runs.assign(fault=("run", truth))) != expected


def test_a_changed_file_is_refused(tmp_path):
    runs = simulated.load_set("armpi_fpv", "healthy", tmp_path)
    path = tmp_path / "simulated" / "armpi_fpv" / "healthy.nc"
    simulated.load_set("armpi_fpv", "healthy", tmp_path)
    runs["measured"].values[0, 0] += 1e-3
    simulated.save_run_set(runs, path)
    with pytest.raises(InputError, match=r"healthy\.nc: has checksum .* was changed"):
        simulated.load_set("armpi_fpv", "healthy", tmp_path)


def test_an_entry_sees_no_truth(data):
    work = runner.Work("armpi_fpv", "robot-P1", data)
    (fold,) = work.folds
    assert set(fold.known[0].data_vars) == {"command", "measured", "duration"}
    assert "fault" in fold.test
    names = [str(name) for name in fold.test["run"].values]
    assert names == [f"armpi_fpv-robot-{number:04d}" for number in range(len(names))]
    faults = fold.test["fault"].values
    assert len(set(faults[:9])) > 3  # not one class after the other


def test_only_the_beginning_is_shown(data):
    (fold,) = runner.Work("armpi_fpv", "ages-P0c-3s", data).folds
    assert fold.test["time"].values[-1] < 3.0
    assert float(fold.test["duration"].max()) < 3.0
    assert set(fold.known[0]["fault"].values) == {"healthy"}


def test_tracks_allow_what_they_say():
    for name, case in tasks.CASES.items():
        labelled = {"labelled", "other", "train"} & set(case.known)
        assert (case.track == "P2") == bool(labelled), name
        assert (case.track == "P1") == (case.test in case.known), name
        assert case.track in tasks.TRACKS
        assert case.test in (*simulated.SETS, tasks.REAL)


# Scores that can be worked out by hand.


def judged(pairs, parts=None, **truths):
    """Return a judgement of (truth, posterior) pairs."""
    answers = [Diagnosis(f"r{i}", posterior) for i, (_, posterior) in enumerate(pairs)]
    known = {f"r{i}": RunTruth(truth, **truths) for i, (truth, _) in enumerate(pairs)}
    return tasks.Judgement(answers, Truths("runs", known), parts or {})


def values(scores):
    return [score.value for score in scores]


SURE_1, SURE_2 = {"healthy": 0.02, "motor_1:stuck": 0.98}, {"healthy": 0.04, "motor_2:stuck": 0.96}
CALM = {"healthy": 0.8, "motor_1:stuck": 0.2}


def test_detection_is_scored():
    task = tasks.TASKS["detect"].score
    scores = task(judged([("healthy", CALM), ("healthy", SURE_1), ("motor_1:stuck", SURE_2)]))
    nats = -np.mean(np.log([0.8, 0.02, 0.96]))
    assert values(scores) == pytest.approx([50.0, 0.0, nats])


def test_an_impossible_truth_is_infinitely_bad():
    scores = tasks.TASKS["isolate"].score(judged([("motor_2:stuck", CALM), ("healthy", CALM)]))
    assert scores[0].value == 50.0
    assert scores[1].value == np.inf
    stored = runner._rounded(scores[1])
    assert (stored["value"], stored["infinite"]) == (None, True)
    assert figure(stored) == "infinite"
    assert runner._rounded(scores[0])["infinite"] is False


def test_blame_is_not_the_true_motor():
    pairs = [("motor_1:slow", SURE_1), ("motor_1:slow", SURE_2), ("healthy", CALM)]
    unknown, blamed, false = tasks.TASKS["unknown"].score(judged(pairs))
    assert (unknown.value, blamed.value, false.value) == (0.0, 50.0, 0.0)


def test_delay_counts_from_the_onset_to_the_first_alarm():
    pairs = [("motor_1:stuck", SURE_1)]
    calm = [Diagnosis("r0", CALM)]
    parts = {"ages-P0c-3s": calm, "ages-P0c-5s": [Diagnosis("r0", SURE_1)], "ages-P0c-7s": calm}
    delay, found, _ = tasks.TASKS["live"].score(judged(pairs, parts, onset=2.5))
    assert (delay.value, found.value) == (2.5, 100.0)
    _, found, _ = tasks.TASKS["live"].score(judged(pairs, parts, onset=5.5))
    assert found.value == 100.0  # what was said before the onset counts for nothing


def test_with_a_wrong_set_up_the_true_motor_may_be_blamed():
    pairs = [("motor_1:stuck", SURE_1), ("motor_1:stuck", SURE_2)]
    pairs += [("healthy", SURE_2), ("healthy", CALM)]
    blamed, right = tasks.TASKS["set_up"].score(judged(pairs))
    assert (blamed.value, right.value) == (50.0, 50.0)


def test_the_smallest_size_is_that_above_all_missed_ones():
    rows = [(0.01, CALM), (0.02, SURE_1), (0.04, CALM), (0.08, SURE_1), (0.16, SURE_1)]
    answers = [Diagnosis(f"r{i}", posterior) for i, (_, posterior) in enumerate(rows)]
    truths = {f"r{i}": RunTruth("motor_1:stuck", 0.0, size) for i, (size, _) in enumerate(rows)}
    scores = tasks.TASKS["smallest"].score(tasks.Judgement(answers, Truths("runs", truths), {}))
    assert scores[0].value == pytest.approx(np.rad2deg(0.08))
    assert scores[0].low == pytest.approx(np.rad2deg(0.04))


@pytest.mark.parametrize("count", [9, 40, 101])
def test_the_interval_of_a_median_holds_it(count):
    """By the binomial distribution of how many values lie below the true median."""
    score = tasks._median("x", np.arange(count, dtype=float))
    low, high = int(score.low), int(score.high)
    covered = binom.cdf(high, count, 0.5) - binom.cdf(low, count, 0.5)
    assert 0.93 < covered < 0.995


# Entries.


class Constant:
    classes_ = np.array(["healthy", "motor_1:stuck"])
    columns = 2

    def fit(self, X, y):
        self.seen = X.shape, sorted(set(y))

    def predict_proba(self, X):
        return np.full((len(X), self.columns), 1.0 / self.columns)


class Adaptive(Constant):
    def adapt(self, X):
        self.adapted = len(X)


@pytest.fixture(scope="module")
def healthy(data):
    return simulated.load_set("armpi_fpv", "healthy", data)


@pytest.fixture
def twin(armpi):
    return DigitalTwin(armpi)


def test_a_classifier_learns_from_what_the_track_allows(healthy, twin):
    entry = Classifier(Adaptive, twin, lambda: healthy, "m:C")
    entry.fit(healthy)
    entry.fit(healthy.drop_vars("fault"))
    answers = entry.diagnose(healthy)
    assert entry._made.seen == ((40, 100 * 10), ["healthy"])
    assert entry._made.adapted == 20
    assert answers[0].posterior == {"healthy": 0.5, "motor_1:stuck": 0.5}


def test_a_classifier_that_cannot_adapt_does_not_take_part(healthy, twin):
    with pytest.raises(NotEnteredError):
        Classifier(Constant, twin, lambda: healthy, "m:C").fit(healthy.drop_vars("fault"))


def test_probabilities_of_other_classes_are_refused(healthy, twin):
    class Wrong(Constant):
        columns = 3

    with pytest.raises(InputError, match=r"gave shape \(20, 3\)"):
        Classifier(Wrong, twin, lambda: healthy, "m:C").diagnose(healthy)


def test_an_unknown_entry_is_refused(twin):
    with pytest.raises(InputError, match="expected module:Class or one of chance"):
        entry_of("guess", twin, lambda: None)


def test_a_run_goes_on_and_its_file_cannot_be_changed(data, tmp_path):
    work = [runner.Work("armpi_fpv", case, data) for case in ("robot-P0", "transfer-P2")]
    first = runner.run_entry("chance", work, tmp_path / "out", lambda done: None)
    answers = tmp_path / "out" / runner.ANSWERS / "armpi_fpv-robot-P0.jsonl"
    begun = answers.stat().st_mtime_ns
    again = runner.run_entry("chance", work, tmp_path / "out", lambda done: None)
    assert answers.stat().st_mtime_ns == begun
    assert again["scores"] == first["scores"]
    isolate = next(s for s in first["scores"] if s["metric"] == "log score [nats]")
    assert isolate["value"] == pytest.approx(np.log(9), abs=1e-4)
    runner.pack(tmp_path / "out", "mine", data, tmp_path / "mine.json")
    packed = runner.read_submission(tmp_path / "mine.json")
    assert packed["scores"] == first["scores"]
    assert len(packed["texts"]) == 2
    with pytest.raises(InputError, match="holds results of 'chance'"):
        runner.run_entry("bayes", work, tmp_path / "out", lambda done: None)
    answers.write_text(answers.read_text().replace("0.1111", "0.1112", 1))
    with pytest.raises(InputError, match="was changed after the run"):
        runner.pack(tmp_path / "out", "mine", data, tmp_path / "mine.json")


@pytest.mark.parametrize("text", ["{}", "[1", '{"benchmark": 1}'])
def test_broken_results_are_refused(text, tmp_path):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(InputError, match=r"results of the benchmark|lacks"):
        runner.read_submission(tmp_path / "x.json")


# Recorded sets.


@pytest.fixture
def little_set(monkeypatch):
    texts = {"label_0/a.csv": b"one", "label_1/a.csv": b"two", "label_1/copy.csv": b"two"}
    hashes = {path: hashlib.sha256(text).hexdigest() for path, text in texts.items()}
    one = real.RealSet("x", "owner/name", "0" * 40, "", "MIT", hashes)
    monkeypatch.setattr(real, "real_sets", lambda: {"little": one})


def test_files_are_known_by_their_content(little_set, tmp_path):
    source = tmp_path / "elsewhere" / "deep"
    source.mkdir(parents=True)
    for name, text in {"q": b"one", "r": b"two", "s": b"other"}.items():
        (source / name).write_bytes(text)
    with tarfile.open(tmp_path / "all.tar.gz", "w:gz") as archive:
        archive.add(source, "repository-0000")
    for place, given in {"x": tmp_path / "elsewhere", "y": tmp_path / "all.tar.gz"}.items():
        assert real.fetch("little", tmp_path / place, given) == 3
        assert real.fetch("little", tmp_path / place, given) == 0
        folder = tmp_path / place / "little"
        folders = real.folders_of("little", tmp_path / place)
        assert folders == [folder / "label_0", folder / "label_1"]
        assert (folder / "label_1" / "copy.csv").read_bytes() == b"two"
    (folder / "label_0" / "a.csv").write_bytes(b"One")
    with pytest.raises(InputError, match="is not the published file"):
        real.folders_of("little", tmp_path / "y")


def test_an_incomplete_copy_is_refused(little_set, tmp_path):
    (tmp_path / "copy").mkdir()
    (tmp_path / "copy" / "q").write_bytes(b"one")
    with pytest.raises(InputError, match="holds no published file for 2 of 3 paths"):
        real.fetch("little", tmp_path / "data", tmp_path / "copy")
    with pytest.raises(InputError, match="cannot be read as"):
        (tmp_path / "q.tar.gz").write_bytes(b"no archive")
        real.fetch("little", tmp_path / "data", tmp_path / "q.tar.gz")


def test_sources_are_stated():
    for name, one in real.real_sets().items():
        assert len(one.commit) == 40 and "/" in one.repository, name
        assert one.licence and all(len(value) == 64 for value in one.files.values())
    assert json.dumps(sorted(real.real_sets()))


def test_filters_name_most_faults(data, twin):
    runs = simulated.load_set("armpi_fpv", "labelled", data)
    entry = entry_of("kalman", twin, lambda: None)
    names = [str(h) for h in simulated.classes_of("armpi_fpv")]
    answers = entry.diagnose(named_runs(runs.drop_vars("fault"), names))
    right = [a.diagnosis == fault for a, fault in zip(answers, runs["fault"].values, strict=True)]
    assert np.mean(right) > 0.5  # 1 in 9 by chance
