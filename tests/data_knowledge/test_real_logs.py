from __future__ import annotations

import numpy as np
import pytest

from failuretwin import ReadOptions, read_runs

PAPER = [
    "healthy",
    *(f"motor_{k}:stuck" for k in range(1, 5)),
    *(f"motor_{k}:steady_state_error" for k in range(1, 5)),
]
FREEZE = 49


@pytest.fixture(scope="module")
def processed(data):
    """The same 90 runs as the authors of the data processed them."""
    with np.load(data / "processed_samples" / "processed_real_20241003.npz") as archive:
        return {name: archive[name] for name in archive.files}


def folder_of(data, label):
    (folder,) = (data / "real_robot_b_20241003" / f"label_{label}").iterdir()
    return folder


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [("command", "commands_rad"), ("position", "responses_rad"), ("measured", "realized_m")],
)
def test_published_form_is_that_of_the_authors(published, processed, ours, theirs):
    expected = processed[theirs][..., : published[ours].shape[-1]]
    assert len(expected) == 90
    np.testing.assert_allclose(published[ours].values, expected, rtol=0, atol=1e-9)


def test_published_form_has_their_time_and_labels(published, processed):
    np.testing.assert_allclose(published["time"], processed["t"], rtol=0, atol=1e-12)
    assert published["fault"].values.tolist() == [PAPER[k] for k in processed["label"]]
    assert published.attrs["measured_rate_hz"] == 10.0


@pytest.mark.parametrize("how", ["published", "measured"])
def test_truth_of_the_labels(how, request, processed):
    runs = request.getfixturevalue(how)
    label = processed["label"]
    stuck = (label >= 1) & (label <= 4)
    assert runs["fault"].values.tolist() == [PAPER[k] for k in label]
    np.testing.assert_array_equal(runs["onset"].values[label == 0], np.nan)
    np.testing.assert_array_equal(runs["onset"].values[label >= 5], 0.0)
    np.testing.assert_allclose(runs["onset"].values[stuck], 0.49, atol=0.001)
    # The angle held is that of the authors' response at the sample where they froze it.
    held = processed["responses_rad"][stuck, FREEZE, label[stuck] - 1]
    np.testing.assert_allclose(runs["magnitude"].values[stuck], held, rtol=0, atol=1e-9)
    assert np.isnan(runs["magnitude"].values[~stuck]).all()
    assert '"published_labels": true' in runs.attrs["configuration"]


@pytest.mark.parametrize("label", [0, 2, 6])
def test_sound_readings_stand_at_their_nearest_grid_time(data, armpi, read_log, tool_at, label):
    folder = folder_of(data, label)
    log = read_log(folder)
    runs = read_runs(folder, armpi)
    assert runs.sizes["run"] == 10
    sound = ((log.counts >= 0) & (log.counts <= 1000)).all(axis=1)
    sound[:-1] &= np.diff(log.reading_time) <= 0.5
    missing = 0
    for run in range(10):
        first = log.command_time[7 * run + 1]
        begin = log.reading_time[log.reading_time < first][-1]
        inside = (log.reading_time >= begin) & (log.reading_time <= log.command_time[7 * run + 6])
        at = np.rint((log.reading_time[inside] - begin) / 0.01).astype(int)
        expected = np.full((runs.sizes["time"], 3), np.nan)
        expected[at[sound[inside]]] = tool_at(log.counts[inside][sound[inside]])
        missing += int((~sound[inside]).sum())

        np.testing.assert_allclose(runs["measured"].values[run], expected, rtol=0, atol=1e-9)
        assert runs["movement_start"].values[run, 0] == pytest.approx(first - begin, abs=1e-6)
    assert missing > 3


def test_measured_form_has_runs_of_five_movements(measured):
    assert measured.sizes["run"] == 90
    np.testing.assert_allclose(np.diff(measured["time"]), 0.01)
    assert np.isfinite(measured["movement_start"]).all()
    assert measured.sizes["movement"] == 5
    assert ((measured["duration"] > 9.9) & (measured["duration"] < 16)).all()
    assert np.isfinite(measured["command"]).all()
    after = measured["time"] > measured["duration"] + 0.005
    assert not np.isfinite(measured["measured"]).where(after, False).any()


def test_gaps_are_left_open(measured, published):
    """The published form has a value everywhere; real readings stop for up to four seconds."""

    def longest_silence(path):
        seen = np.flatnonzero(np.isfinite(path).all(axis=1))
        return np.diff(seen).max() * 0.01

    silences = [longest_silence(path) for path in measured["measured"].values]
    assert sum(s > 0.5 for s in silences) >= 60
    assert max(silences) > 3.0
    assert np.isfinite(published["measured"]).all()


@pytest.mark.parametrize("label", range(1, 5))
def test_labelled_motor_is_frozen_only_when_labels_are_published(data, armpi, measured, label):
    whole = read_runs(folder_of(data, label), armpi)
    frozen = measured.isel(run=slice(10 * label, 10 * label + 10))
    assert "fault" not in whole
    motor = label - 1
    for run in range(10):
        after = frozen["time"].values >= 0.4905
        angle = frozen["position"].values[run][after]
        seen = np.isfinite(angle).all(axis=1)
        assert np.ptp(angle[seen, motor]) == 0.0
        others = [m for m in range(4) if m != motor]
        assert (np.ptp(angle[seen][:, others], axis=0) > 0.1).all()
    free = np.nanmax(whole["position"][..., motor], 1) - np.nanmin(whole["position"][..., motor], 1)
    assert (free > 0.1).all()
    before = slice(0, FREEZE)
    np.testing.assert_array_equal(
        frozen["measured"].values[:, before], whole["measured"].values[:, before]
    )


@pytest.mark.parametrize("label", [0, 5, 8])
def test_other_labels_change_no_reading(data, armpi, label):
    folder = folder_of(data, label)
    plain, labelled = (read_runs(folder, armpi, ReadOptions("measured", x)) for x in (False, True))
    np.testing.assert_array_equal(plain["measured"], labelled["measured"])
    np.testing.assert_array_equal(plain["command"], labelled["command"])


def test_older_campaign_is_a_run_a_session(data, armpi):
    runs = read_runs(data / "killian_runs_dev", armpi)
    folders = [path for path in (data / "killian_runs_dev").glob("*/*") if path.is_dir()]
    assert runs.sizes["run"] == len(folders) == 115
    assert len(set(runs["run"].values)) == 115
    assert {name.split("/")[0] for name in runs["run"].values} == {f.name for f in folders}
    movements = np.isfinite(runs["movement_start"]).sum("movement")
    assert sorted(set(movements.values.tolist())) == [4, 5]
    assert np.isfinite(runs["measured"]).all("axis").any("time").all()


def test_healthy_logs_are_eight_runs_of_the_same_eight_movements(data, armpi):
    runs = read_runs(data / "healthy_logs", armpi)
    assert runs.sizes["run"] == runs.sizes["movement"] == 8
    np.testing.assert_allclose(runs["target"], runs["target"][[0] * 8], atol=1e-12)
    np.testing.assert_allclose(runs["ramp_duration"], 1.0)
