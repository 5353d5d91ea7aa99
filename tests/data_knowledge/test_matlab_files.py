from __future__ import annotations

import matio
import numpy as np
import pytest
import scipy.io

from failuretwin import BayesDiagnoser, ReadOptions, read_runs
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.readers.matlab import export_runs, hypothesis_of_label, label_text

PAIRS = ("Healthy", "Motor_3_Stuck", "Motor_1_Steady_state_error")


@pytest.fixture(scope="module")
def cells(data, armpi, tmp_path_factory):
    """Every tenth of the 90 published cells, in a file of its own: a run of each class."""
    whole = scipy.io.loadmat(data / "processed_samples" / "cell_array_20241003.mat")
    path = tmp_path_factory.mktemp("cells") / "cell_array_20241003.mat"
    scipy.io.savemat(
        path, {name: whole[name][:, ::10] for name in ("X_test_array", "y_test_array")}
    )
    return read_runs(path, armpi)


@pytest.fixture(scope="module")
def authors(data):
    return np.load(data / "processed_samples" / "processed_real_20241003.npz", allow_pickle=True)


def unwrapped(cells, k):
    """Return the properties of the k-th timeseries, however deep the cells are nested."""
    item = np.ravel(cells)[k]
    while isinstance(item, np.ndarray):
        item = item.ravel()[0]
    return item.properties


@pytest.mark.parametrize("folder", PAIRS)
def test_an_original_pair_loads_with_its_commands(data, armpi, folder):
    runs = read_runs(data / "processed_samples" / folder, armpi)

    hidden = matio.load_from_mat(str(data / f"processed_samples/{folder}/hidden_dataset_1.mat"))
    commands, responses = np.ravel(hidden["hidden_dataset"])
    for k in range(4):
        series = unwrapped(commands, k)
        np.testing.assert_array_equal(runs["command"].values[0, :, k], np.ravel(series["Data_"]))
        series = unwrapped(responses, k)
        np.testing.assert_array_equal(runs["position"].values[0, :, k], np.ravel(series["Data_"]))
    assert runs["fault"].item() == hypothesis_of_label(folder, armpi)
    assert runs.attrs["measured_rate_hz"] == 10.0


def test_a_pair_without_its_hidden_half_gets_its_commands_back(data, armpi, tmp_path):
    source = data / "processed_samples" / "Healthy"
    (tmp_path / "dataset_1.mat").write_bytes((source / "dataset_1.mat").read_bytes())

    recovered = read_runs(tmp_path / "dataset_1.mat", armpi)

    given = read_runs(source, armpi)
    np.testing.assert_allclose(recovered["command"], given["command"], atol=1e-9)


def test_commands_of_a_cell_array_are_recovered(cells, authors, twin):
    path = twin.path(cells["command"].values)

    np.testing.assert_allclose(path, authors["desired_m"][::10], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(cells["measured"], authors["realized_m"][::10])


def test_the_same_runs_get_the_same_diagnoses(cells, data, armpi, twin):
    raw = read_runs(data / "real_robot_b_20241003", armpi, ReadOptions("published", True))
    diagnoser = BayesDiagnoser(twin)

    from_cells = diagnoser.diagnose(cells.isel(run=slice(None, None, 4)))
    from_logs = diagnoser.diagnose(raw.isel(run=slice(None, None, 40)))

    assert [d.truth for d in from_cells] == [d.truth for d in from_logs]
    assert [d.diagnosis for d in from_cells] == [d.diagnosis for d in from_logs]


def test_written_cells_read_back_equal(cells, armpi, twin, tmp_path):
    some = cells.isel(run=[0, 1])
    export_runs(some, tmp_path / "some.mat", twin)

    back = read_runs(tmp_path / "some.mat", armpi)

    np.testing.assert_array_equal(back["measured"], some["measured"])
    np.testing.assert_allclose(back["command"], some["command"], atol=1e-9)
    assert back["fault"].values.tolist() == some["fault"].values.tolist()
    content = scipy.io.loadmat(tmp_path / "some.mat")
    assert content["X_test_array"].shape == content["y_test_array"].shape == (1, 2)
    assert content["y_test_array"][0, 1].item() == "Motor_1_Stuck"


def test_written_pairs_read_back_equal(cells, armpi, twin, tmp_path):
    some = cells.isel(run=[0, 0, 1])
    export_runs(some, tmp_path / "pairs", twin)

    back = read_runs(tmp_path / "pairs", armpi)

    np.testing.assert_array_equal(back["command"], some["command"])
    np.testing.assert_array_equal(back["measured"], some["measured"])
    assert back["fault"].values.tolist() == some["fault"].values.tolist()
    assert (tmp_path / "pairs" / "Healthy" / "dataset_2.mat").exists()
    hidden = scipy.io.loadmat(tmp_path / "pairs" / "Motor_1_Stuck" / "hidden_dataset_1.mat")
    assert hidden["hidden_dataset"].shape == (1, 2)


@pytest.mark.parametrize("number", range(9))
def test_labels_and_hypotheses_are_the_same_thing(armpi, authors, number):
    label = str(authors["class_names"][number])

    assert label_text(hypothesis_of_label(label, armpi)) == label


def test_a_path_that_no_commands_make_is_named(cells, armpi, tmp_path, twin):
    both = np.hstack([twin.path(cells["command"].values[0]), cells["measured"].values[0]])
    both[:, :3] += 1e-3 * np.random.default_rng(0).normal(size=(len(both), 3))
    scipy.io.savemat(tmp_path / "dataset_1.mat", {"dataset": both})

    with pytest.raises(InputError, match=r"dataset_1.*holds its commands"):
        read_runs(tmp_path / "dataset_1.mat", armpi)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"other": np.zeros(3)}, "holds other; expected `dataset`"),
        ({"dataset": np.zeros((10, 5))}, r"shape \(10, 5\), expected \(samples, 6\)"),
        ({"dataset": np.full((10, 6), np.nan)}, "desired path has values that are not finite"),
    ],
)
def test_files_of_another_kind_are_refused(armpi, tmp_path, content, words):
    scipy.io.savemat(tmp_path / "dataset_1.mat", content)

    with pytest.raises(InputError, match=words):
        read_runs(tmp_path / "dataset_1.mat", armpi)
