from __future__ import annotations

import dataclasses
import shutil

import numpy as np
import pytest

from failuretwin import ReadOptions, read_runs, sample_log
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.readers.raw_sessions import (
    SESSION_FILES,
    find_sessions,
    read_session,
)

COMMAND, DURATION, POSITION = SESSION_FILES


def edit(path, change):
    path.write_text(change(path.read_text()))


def edit_cell(path, row, column, text):
    """Replace what stands in a 0-based data row under a column name."""
    lines = path.read_text().splitlines()
    cells = lines[row + 1].split(",")
    cells[lines[0].split(",").index(column)] = text
    lines[row + 1] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")


def seen(runs, run=0):
    return np.flatnonzero(np.isfinite(runs["measured"].values[run]).all(axis=1))


def test_session_with_known_motion_comes_back(session, armpi, tool_at):
    runs = read_runs(session.write(), armpi)

    # The last reading before the first command is at -0.05 s: that is t = 0 of the run.
    readings = session.reading_time[session.reading_time > -0.06]
    samples = np.rint((readings + 0.05) / 0.01).astype(int)
    np.testing.assert_array_equal(seen(runs), samples)
    np.testing.assert_allclose(
        runs["measured"].values[0, samples], tool_at(session.counts(readings)), rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(
        runs["movement_start"].values[0], session.command_time + 0.05, atol=1e-5
    )
    np.testing.assert_allclose(
        runs["target"].values[0], np.deg2rad(120 - 0.24 * session.targets), atol=1e-12
    )
    np.testing.assert_allclose(runs["ramp_duration"].values, 0.8)
    assert runs["run"].values.tolist() == ["session/run_01"]
    assert runs.attrs["robot"] == "armpi_fpv"
    assert runs.attrs["measured_rate_hz"] == 10.0


def test_command_is_a_ramp_to_the_target_then_holds(session, armpi):
    runs = read_runs(session.write(), armpi)
    time = runs["time"].values - 0.05
    corners = np.ravel([session.command_time, session.command_time + 0.8], order="F")
    values = np.repeat(np.vstack([[500.0] * 4, session.targets]), 2, axis=0)[1:-1]
    expected = np.stack([np.interp(time, corners, v) for v in values.T], axis=-1)
    np.testing.assert_allclose(
        runs["command"].values[0], np.deg2rad(120 - 0.24 * expected), rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("value", [-1.0, 1001.0, 32447.0, -32503.0])
def test_readings_out_of_range_are_missing(session, armpi, value):
    whole = read_runs(session.write("whole"), armpi)
    spoilt = read_runs(session.write("spoilt", counts={30: [500, 500, value, 500]}), armpi)
    lost = np.setdiff1d(seen(whole), seen(spoilt))
    assert lost.tolist() == [250]
    assert np.setdiff1d(seen(spoilt), seen(whole)).size == 0


def test_glitches_of_the_gripper_do_not_matter(session, armpi):
    whole, spoilt = session.write("whole"), session.write("spoilt")
    edit_cell(spoilt / POSITION, 30, "motor_1", "32447.0")
    edit_cell(spoilt / POSITION, 31, "motor_2", "-1.0")
    paths = [read_runs(folder, armpi)["measured"] for folder in (whole, spoilt)]
    np.testing.assert_array_equal(*paths)


def test_the_reading_before_a_gap_is_missing_too(session, armpi):
    whole = read_runs(session.write("whole"), armpi)
    gappy = read_runs(session.write("gappy", gap=(31, 61)), armpi)
    lost = np.setdiff1d(seen(whole), seen(gappy))
    np.testing.assert_array_equal(lost, np.arange(30, 61) * 10 - 50)


def test_a_pause_below_half_a_second_is_no_gap(session, armpi):
    whole = read_runs(session.write("whole"), armpi)
    pause = read_runs(session.write("pause", gap=(31, 34)), armpi)
    lost = np.setdiff1d(seen(whole), seen(pause))
    np.testing.assert_array_equal(lost, np.arange(31, 34) * 10 - 50)


def test_columns_are_found_by_name(session, armpi):
    plain, shuffled = session.write("plain"), session.write("shuffled")
    for name in SESSION_FILES:
        rows = [line.split(",") for line in (shuffled / name).read_text().splitlines()]
        order = [4, 0, 6, 1, 5, 2, 3]
        (shuffled / name).write_text("\n".join(",".join(r[i] for i in order) for r in rows) + "\n")
    runs = [read_runs(folder, armpi) for folder in (plain, shuffled)]
    assert runs[0].drop_vars("run").identical(runs[1].drop_vars("run"))


def test_the_robots_clock_does_not_matter(session, armpi):
    now = read_runs(session.write("now"), armpi)
    session.epoch = 0.0
    then = read_runs(session.write("then"), armpi)
    np.testing.assert_array_equal(seen(now)[:-1], seen(then)[:-1])
    np.testing.assert_allclose(now["command"][:, :999], then["command"][:, :999], atol=1e-5)


def test_home_and_repeat_rows_belong_to_no_run(session, armpi):
    rng = np.random.default_rng(1)
    blocks = []
    for _ in range(3):
        moves = rng.integers(300, 700, (5, 4)).astype(float)
        blocks += [np.full((1, 4), 500.0), moves, moves[-1:]]
    session.targets, session.until_s = np.concatenate(blocks), 44.0

    runs = read_runs(session.write(), armpi)

    assert runs["run"].values.tolist() == [f"session/run_{i:02d}" for i in (1, 2, 3)]
    for run in range(3):
        moves = session.targets[7 * run + 1 : 7 * run + 6]
        np.testing.assert_allclose(runs["target"].values[run], np.deg2rad(120 - 0.24 * moves))
        np.testing.assert_allclose(runs["command"].values[run, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(runs["duration"], 10.05, atol=0.011)


def test_published_form_fills_gaps_by_straight_lines(session, armpi, tool_at):
    folder = session.write(gap=(31, 61), counts={70: [1200, 500, 500, 500]})
    runs = read_runs(folder, armpi, ReadOptions("published"))

    assert runs.sizes["time"] == 1000
    assert np.isfinite(runs["measured"]).all()
    kept = np.r_[0:31, 61 : len(session.reading_time)]
    counts = session.counts(session.reading_time)
    counts[70] = [1200, 500, 500, 500]
    time = np.linspace(0, 10, 1000) - 0.05
    filled = [np.interp(time, session.reading_time[kept], c) for c in counts[kept].T]
    expected = tool_at(np.clip(np.stack(filled, axis=-1), 0, 1000))
    np.testing.assert_allclose(runs["measured"].values[0], expected, rtol=0, atol=1e-6)


def test_log_that_ends_early_is_read_as_far_as_it_goes(session, armpi):
    session.until_s = 5.0
    runs = read_runs(session.write(), armpi)
    assert runs["duration"].values[0] == pytest.approx(5.0, abs=0.011)


def test_published_form_ends_with_the_log(session, armpi):
    """Lines are drawn between readings; after the last one nothing is known."""
    session.until_s = 5.0
    runs = read_runs(session.write(), armpi, ReadOptions("published"))
    assert not np.isfinite(runs["measured"].values[0, runs["time"] > 5.05]).any()


@pytest.mark.parametrize("until_s", [-0.1, 0.3, 0.75])
@pytest.mark.parametrize("how", ["measured", "published"])
def test_log_that_ends_before_the_first_movement_does_is_refused(session, armpi, until_s, how):
    session.until_s = until_s
    with pytest.raises(InputError, match=r"readings end before .* one whole movement"):
        read_runs(session.write(), armpi, ReadOptions(how))


def test_sessions_are_found_downwards_in_order(session):
    for name in ("b/2", "a", "b/1"):
        session.write(name)
    (session.folder / "empty").mkdir()
    found = find_sessions(session.folder)
    assert [str(path.relative_to(session.folder)) for path in found] == ["a", "b/1", "b/2"]
    assert find_sessions(session.folder / "a") == [session.folder / "a"]
    assert find_sessions(session.folder / "empty") == []


def test_all_sessions_below_a_folder_become_one_run_set(session, armpi):
    for name in ("x/one", "y/one", "y/two"):
        session.write(name)
    runs = read_runs([session.folder / "x", str(session.folder / "y")], armpi)
    assert runs["run"].values.tolist() == ["one/run_01", "one/run_01#2", "two/run_01"]


@pytest.mark.parametrize("missing", SESSION_FILES)
def test_incomplete_session_names_the_missing_file(session, missing):
    folder = session.write()
    (folder / missing).unlink()
    with pytest.raises(InputError, match=rf"needs three files.*; missing: {missing}\."):
        find_sessions(session.folder)


@pytest.mark.parametrize("file", SESSION_FILES)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: "", "is empty"),
        (lambda text: text.splitlines()[0] + "\n", "has a header but no rows"),
        (lambda text: text.replace("motor_6", "motor6"), "'motor_6'. Did you mean 'motor6'"),
        (lambda text: text.replace("timestamp", "stamp"), "unknown column 'timestamp'"),
        (lambda text: text.replace("motor_2", "motor_6"), "motor_6"),
    ],
    ids=["empty", "no rows", "no motor_6", "no timestamp", "motor_6 twice"],
)
def test_unusable_table_is_named(session, armpi, file, change, message):
    folder = session.write()
    edit(folder / file, change)
    with pytest.raises(InputError) as error:
        read_session(folder, armpi)
    assert str(folder / file) in str(error.value)
    assert message in str(error.value)


@pytest.mark.parametrize("text", ["fast", "", "nan", "inf"])
@pytest.mark.parametrize("file", SESSION_FILES)
def test_cell_that_is_no_number_is_pointed_at(session, armpi, file, text):
    folder = session.write()
    edit_cell(folder / file, 2, "motor_4", text)
    expected = "a finite number" if text == "inf" else "a number"
    with pytest.raises(InputError, match=f"{file}: line 4, column motor_4: .*expected {expected}"):
        read_session(folder, armpi)


@pytest.mark.parametrize("stamp", ["1699999999.0", "1700000002.0"])
def test_time_that_does_not_run_forwards_is_pointed_at(session, armpi, stamp):
    folder = session.write()
    edit_cell(folder / COMMAND, 2, "timestamp", stamp)
    with pytest.raises(InputError, match=r"cmd\.csv: time runs backwards .* at line 4 "):
        read_session(folder, armpi)


def test_durations_must_match_the_commands(session, armpi):
    folder = session.write()
    edit(folder / DURATION, lambda text: "\n".join(text.splitlines()[:-1]) + "\n")
    with pytest.raises(InputError, match=r"has 5 rows and .* 4\. Expected a duration"):
        read_session(folder, armpi)


def test_a_log_of_glitches_alone_is_refused(session, armpi):
    everything = range(len(session.reading_time))
    folder = session.write(counts={row: [500, 500, 500, 32000] for row in everything})
    with pytest.raises(InputError, match=r"no reading lies within the servo's range of 0 to 1000"):
        read_session(folder, armpi)


def test_published_labels_need_folder_names_that_say_so(session, armpi):
    folder = session.write("20240101_label_3")
    options = ReadOptions(published_labels=True)
    assert read_runs(folder, armpi, options)["fault"].values.tolist() == ["motor_3:stuck"]
    other = session.write("label_9")
    with pytest.raises(InputError, match=r"_label_0 to _label_8; this one is 'label_9'"):
        read_runs(other, armpi, options)


def test_robot_without_log_columns_cannot_read_sessions(session, armpi):
    motors = tuple(dataclasses.replace(motor, log_column="") for motor in armpi.motors)
    robot = dataclasses.replace(armpi, profile=dataclasses.replace(armpi.profile, motors=motors))
    with pytest.raises(InputError, match="no log_column"):
        read_session(session.write(), robot)


@pytest.mark.parametrize("name", ["nothing", "nothing.nc"])
def test_source_that_does_not_exist_is_named(tmp_path, armpi, name):
    with pytest.raises(InputError, match=rf"{name}: does not exist"):
        read_runs(tmp_path / name, armpi)


def test_folder_without_sessions_says_what_a_session_is(tmp_path, armpi):
    with pytest.raises(InputError, match=f"no log in it or below.*{COMMAND}"):
        read_runs(tmp_path, armpi)


def test_a_folder_of_tables_is_read_in_the_order_of_their_names(tmp_path, armpi):
    (tmp_path / "may").mkdir()
    for name in ("may/b.csv", "a.csv"):
        shutil.copy(sample_log(), tmp_path / name)
    runs = read_runs(tmp_path, armpi)
    names = [f"{log}/run_{number}" for log in "ab" for number in (1, 2, 3)]
    assert runs["run"].values.tolist() == names


def test_no_sources_are_refused(armpi):
    with pytest.raises(InputError, match="Expected"):
        read_runs([], armpi)


def test_reading_changes_no_file(session, armpi):
    folder = session.write()
    copy = shutil.copytree(folder, session.folder / "copy")
    read_runs(folder, armpi)
    for name in SESSION_FILES:
        assert (folder / name).read_bytes() == (copy / name).read_bytes()
    assert sorted(path.name for path in folder.iterdir()) == sorted(SESSION_FILES)
