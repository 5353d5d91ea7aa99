from __future__ import annotations

import re
import sys

import numpy as np
import onnxruntime
import pytest
import torch

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.decision.learned.diagnoser import LearnedDiagnoser
from failuretwin.decision.learned.feature_encoder import FeatureEncoder, expectation_of, signals_of
from failuretwin.decision.learned.log_pool import PoolWeights
from failuretwin.decision.learned.networks import NETWORKS
from failuretwin.decision.learned.storage import (
    export_onnx,
    load_network,
    save_network,
)

ALL = pytest.mark.parametrize("network", list(NETWORKS))


@pytest.fixture(scope="module")
def runs(armpi, measured_armpi):
    return simulate(Plan(armpi, paper_hypotheses(armpi.motor_names), 4, 2, measured_armpi))


@pytest.fixture(scope="module")
def trained(armpi, measured_armpi, runs):
    """A network of each kind that has learned a little, with a temperature of its own."""
    encoder = FeatureEncoder("robust", armpi, expectation_of(armpi, measured_armpi))

    def make(name):
        diagnoser = LearnedDiagnoser(name, encoder, iterations=2, random_state=1).fit(runs)
        diagnoser.temperature_, diagnoser.weights_ = 0.7, PoolWeights(0.4, 0.6)
        return diagnoser

    return {name: make(name) for name in NETWORKS}


@ALL
def test_a_stored_network_answers_the_same(armpi, trained, runs, network, tmp_path):
    path = tmp_path / "network.npz"
    save_network(trained[network], path)
    again = load_network(path, armpi)
    np.testing.assert_array_equal(again.predict_proba(runs), trained[network].predict_proba(runs))
    assert again.get_params()["random_state"] == 1
    assert (again.weights_, again.movements_) == (PoolWeights(0.4, 0.6), (5, 5))
    first, second = (d.diagnose(runs)[0].to_record() for d in (again, trained[network]))
    assert first == second


@pytest.mark.parametrize(
    "network",
    [pytest.param(name, marks=[pytest.mark.slow] * (name != "cnn")) for name in NETWORKS],
)
def test_onnx_runtime_agrees(trained, runs, network, tmp_path):
    pytest.importorskip("onnxscript")
    path = tmp_path / "network.onnx"
    export_onnx(trained[network], path)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    features = trained[network].encoder.encode(signals_of(runs))
    for count in (1, 36):
        (chances,) = session.run(None, {"features": features[:count]})
        np.testing.assert_allclose(
            chances, trained[network].predict_proba(features[:count]), atol=2e-6
        )
    named = session.get_modelmeta().custom_metadata_map["classes"].split(",")
    assert named == list(trained[network].classes_)


def test_loading_runs_no_code(armpi, trained, tmp_path):
    path = tmp_path / "evil.npz"

    class Evil:
        def __reduce__(self):
            return (sys.exit, ("code was run",))

    with path.open("wb") as file:
        np.savez(file, configuration=np.array([Evil()], dtype=object))
    with pytest.raises(InputError, match="cannot be read as a network"):
        load_network(path, armpi)


@pytest.mark.parametrize("damage", ["empty", "cut", "text", "missing", "other archive", "format"])
def test_a_file_that_is_no_network_is_refused(armpi, trained, tmp_path, damage):
    path = tmp_path / "network.npz"
    save_network(trained["cnn"], path)
    whole = path.read_bytes()
    with np.load(path) as stored:
        arrays = dict(stored)
    if damage == "empty":
        path.write_bytes(b"")
    elif damage == "cut":
        path.write_bytes(whole[: len(whole) // 2])
    elif damage == "text":
        path.write_text("no network")
    elif damage == "missing":
        path.unlink()
    elif damage == "other archive":
        np.savez(path, a=np.zeros(3))
    else:
        text = arrays["configuration"].tobytes().replace(b'"format": 1', b'"format": 9')
        np.savez(path, **{**arrays, "configuration": np.frombuffer(text, dtype=np.uint8)})
    with pytest.raises(InputError, match="format 9" if damage == "format" else "failuretwin train"):
        load_network(path, armpi)


def test_a_network_for_another_robot_is_refused(trained, tmp_path):
    from failuretwin import load_robot

    path = tmp_path / "network.npz"
    save_network(trained["cnn"], path)
    with pytest.raises(InputError, match="trained for robot 'armpi_fpv'"):
        load_network(path, load_robot("ur5e"))


def test_names_of_exported_files_are_checked(trained, tmp_path):
    with pytest.raises(InputError, match=r"ends in \.npz"):
        save_network(trained["cnn"], tmp_path / "network.pt")


def test_the_stored_file_holds_versions(trained, tmp_path):
    import json

    path = tmp_path / "network.npz"
    save_network(trained["cnn"], path)
    with np.load(path, allow_pickle=False) as stored:
        configuration = json.loads(stored["configuration"].tobytes())
    assert configuration["versions"]["torch"] == torch.__version__
    assert configuration["encoder"]["features"] == "robust"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mean", np.nan),
        ("spread", np.ones(3, dtype=np.float32)),
        ("temperature", "0.0"),
        ("temperature", '"hot"'),
    ],
)
def test_a_network_with_numbers_that_make_no_sense_is_refused(
    armpi, trained, tmp_path, name, value
):
    path = tmp_path / "network.npz"
    save_network(trained["cnn"], path)
    with np.load(path) as stored:
        arrays = dict(stored)
    if isinstance(value, str):
        text = arrays["configuration"].tobytes().decode()
        text, times = re.subn(rf'"{name}": [0-9.]+', f'"{name}": {value}', text)
        assert times == 1
        arrays["configuration"] = np.frombuffer(text.encode(), dtype=np.uint8)
    else:
        arrays[name] = value * np.ones_like(arrays[name]) if np.ndim(value) == 0 else value
    np.savez(path, **arrays)
    with pytest.raises(InputError, match="cannot be read as a network"):
        load_network(str(path), armpi)


def test_an_array_under_the_name_of_a_network_is_refused(armpi, tmp_path):
    path = tmp_path / "network.npz"
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(InputError, match="cannot be read as a network"):
        load_network(path, armpi)
