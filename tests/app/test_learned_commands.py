from __future__ import annotations

import itertools
import json
import sys
from functools import partial

import click
import numpy as np
import pytest
from click.testing import CliRunner

from failuretwin import BayesDiagnoser, load_robot, read_runs
from failuretwin.app.cli import cli
from failuretwin.core.errors import FailureTwinError, InputError
from failuretwin.decision import training, training_data
from failuretwin.decision.learned import storage
from failuretwin.decision.learned.log_pool import log_pool
from failuretwin.decision.learned.storage import load_network, save_network


def run(*arguments):
    """Run a command in this process; errors meant for users are raised."""
    given = [str(argument) for argument in arguments]
    return CliRunner().invoke(cli, given, catch_exceptions=False, standalone_mode=False)


def chunks_here(stream):
    """Yield the runs that another process would make, which would import all libraries first."""
    for number in itertools.count():
        yield stream.data.chunk(number, training_data.CHUNK_RUNS)


def noted(network, path):
    """Write what would be exported; the export itself is judged in test_motorwise.py."""
    path.write_text(" ".join(map(str, network.classes_)))


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """A network that has seen four batches, and what training it printed."""
    path = tmp_path_factory.mktemp("network") / "network.npz"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(storage, "export_onnx", noted)
        patch.setattr(training.PopulationStream, "chunks", chunks_here)
        patch.setattr(training, "TrainingPlan", partial(training.TrainingPlan, validation_runs=18))
        patch.setattr(training_data, "CHUNK_RUNS", 96)
        onnx = path.with_suffix(".onnx")
        answer = run("train", "--out", path, "--onnx", onnx, "--iterations", 4, "--seed", 3)
    return path, answer.output


def test_a_missing_onnx_library_is_told_before_the_training(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(FailureTwinError, match=r"failuretwin\[learn\]"):
        run("train", "--out", tmp_path / "n.npz", "--onnx", tmp_path / "n.onnx")
    assert not list(tmp_path.iterdir())


def test_a_trained_network_is_calibrated_on_the_other_engine(network, armpi):
    path, told = network
    loaded = load_network(path, armpi)
    assert "9 simulated runs of the physics engine" in told
    assert "blended with Bayes" in told
    assert loaded.weights_.bayes > loaded.weights_.network  # it has seen four batches
    assert f"temperature {loaded.temperature_:.2f}" in told
    assert loaded.temperature_ != 1.0
    assert loaded.encoder.imperfections.name == "armpi_fpv"
    assert next(iter(loaded.classes_)) == "healthy"
    assert path.with_suffix(".onnx").read_text().split() == list(loaded.classes_)


def test_a_network_diagnoses_as_bayes_does(failuretwin, network, simulated, tmp_path):
    path, _ = network
    out = tmp_path / "out.jsonl"
    answer = failuretwin("diagnose", simulated, "--method", path, "--json", out)
    assert answer.returncode == 0, answer.stderr
    records = [json.loads(line) for line in out.read_text().splitlines()]
    expected = load_network(path, load_robot("armpi_fpv")).predict_proba(read_runs(simulated))
    got = [list(record["posterior"].values()) for record in records]
    np.testing.assert_allclose(got, expected, atol=1e-6)  # single precision
    assert {record["protocol"] for record in records} == {"P0c"}
    assert "network; healthy" in records[0]["method"]
    assert "of 9 runs right" in answer.stdout


def test_a_network_is_blended_with_bayes(network, simulated, tmp_path, armpi, twin):
    path, _ = network
    out = tmp_path / "out.jsonl"
    run("diagnose", simulated, "--method", f"bayes+{path}", "--json", out)
    records = [json.loads(line) for line in out.read_text().splitlines()]
    runs, loaded = read_runs(simulated), load_network(path, armpi)
    classes = loaded.classes_.tolist()
    bayes = [[d.posterior[c] for c in classes] for d in BayesDiagnoser(twin).diagnose(runs)]
    expected = log_pool(np.array(bayes), loaded.predict_proba(runs), loaded.weights_)
    got = [[record["posterior"][c] for c in classes] for record in records]
    np.testing.assert_allclose(got, expected, atol=1e-6)  # single precision
    assert records[0]["method"].startswith("blended: bayes")


def test_a_network_that_was_never_fitted_beside_bayes_is_not_blended(
    network, simulated, tmp_path, armpi
):
    alone = load_network(network[0], armpi)
    alone.weights_ = None
    save_network(alone, tmp_path / "alone.npz")
    with pytest.raises(InputError, match="never fitted"):
        run("diagnose", simulated, "--method", f"bayes+{tmp_path / 'alone.npz'}")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--method", "nothing.npz"], "failuretwin train --out nothing.npz"),
        (["--method", "bayes+nothing.npz"], "failuretwin train --out nothing.npz"),
        (["--method", "NETWORK", "--onset", "0.49"], "--onset"),
        (["--method", "NETWORK", "--hypotheses", "healthy"], "--hypotheses"),
        (["--method", "RUNS"], "cannot be read as a network"),
    ],
)
def test_methods_that_cannot_be_used_are_refused(network, simulated, arguments, words):
    given = [{"NETWORK": network[0], "RUNS": simulated}.get(a, a) for a in arguments]
    with pytest.raises(InputError, match=words):
        run("diagnose", simulated, *given)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--out", "network.pt"], "ends in .npz"),
        (["--out", "nowhere/network.npz"], "does not exist"),
        (["--out", "network.npz", "--device", "gpu"], "is not one of"),
        (["--out", "network.npz", "--calibration", "none.toml"], "none.toml"),
    ],
)
def test_training_that_cannot_work_is_refused_at_once(tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((FailureTwinError, click.UsageError), match=words):
        run("train", *arguments)
    assert list(tmp_path.iterdir()) == []
