from __future__ import annotations

import re
import sys

import numpy as np
import pytest
import torch

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.decision.learned.diagnoser import MotorwiseDiagnoser
from failuretwin.decision.learned.moment_encoder import MomentEncoder
from failuretwin.decision.learned.storage import load_network, save_network


@pytest.fixture(scope="module")
def trained(armpi, measured_armpi):
    """A network that has learned a little."""
    runs = simulate(Plan(armpi, paper_hypotheses(armpi.motor_names), 4, 2, measured_armpi))
    encoder = MomentEncoder(armpi, measured_armpi)
    return MotorwiseDiagnoser(encoder, iterations=2, random_state=1).fit(runs)


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
    save_network(trained, path)
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
        text = arrays["configuration"].tobytes().replace(b'"format": 2', b'"format": 9')
        np.savez(path, **{**arrays, "configuration": np.frombuffer(text, dtype=np.uint8)})
    with pytest.raises(InputError, match="format 9" if damage == "format" else "failuretwin train"):
        load_network(path, armpi)


def test_names_of_exported_files_are_checked(trained, tmp_path):
    with pytest.raises(InputError, match=r"ends in \.npz"):
        save_network(trained, tmp_path / "network.pt")


def test_the_stored_file_holds_versions(trained, tmp_path):
    import json

    path = tmp_path / "network.npz"
    save_network(trained, path)
    with np.load(path, allow_pickle=False) as stored:
        configuration = json.loads(stored["configuration"].tobytes())
    assert configuration["versions"]["torch"] == torch.__version__
    assert configuration["robot"] == "armpi_fpv"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("weight/mean", np.nan),
        ("weight/spread", np.ones(3, dtype=np.float32)),
        ("temperature", "0.0"),
        ("temperature", '"hot"'),
    ],
)
def test_a_network_with_numbers_that_make_no_sense_is_refused(
    armpi, trained, tmp_path, name, value
):
    path = tmp_path / "network.npz"
    save_network(trained, path)
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
