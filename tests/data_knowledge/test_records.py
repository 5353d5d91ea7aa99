"""The store on SQLite and PostgreSQL, judged by sqlite3, psql and pandas."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from hashlib import sha256

import pandas as pd
import pytest

import failuretwin as ft
from failuretwin.core.errors import InputError, OutputError
from failuretwin.data_knowledge.records.log_files import LogFile, log_file
from failuretwin.data_knowledge.records.queries import QUESTIONS
from failuretwin.data_knowledge.records.schema import Basis
from store_places import diagnosis

DAY = datetime(2026, 3, 2, tzinfo=UTC)


def a_log(days, name="log"):
    """Return a log of its own, recorded some days after the first."""
    checksum = sha256(f"{name} {days}".encode()).hexdigest()
    return LogFile(f"/logs/{name}_{days}.csv", checksum, 10, DAY + timedelta(days=days))


@pytest.fixture
def store(place):
    return ft.open_store(place.url, create=True)


def follow(store, *names, robot="arm_7"):
    """Remember a diagnosis a day."""
    for day, name in enumerate(names):
        given = name if isinstance(name, tuple) else (name,)
        store.remember([diagnosis("run", *given)], robot, log=a_log(day))
    return store.history(robot).episodes


def test_a_diagnosis_is_stored_as_it_is(store, place, armpi):
    told = diagnosis(
        *("run_1", "motor_2:stuck"),
        onset_s=0.5,
        onset_90=(0.25, 0.75),
        magnitude=-0.125,
        magnitude_unit="rad",
        magnitude_90=(-0.25, -0.0625),
        quality=("movement 3 is missing",),
        protocol="P0c",
    )
    done = store.remember([told], "arm_7", log=a_log(0), profile=armpi)
    assert (done.added, done.known, len(done.episodes)) == (1, 0, 1)
    columns = (
        *("state", "hypothesis", "probability", "onset_s", "onset_low_s", "onset_high_s"),
        *("magnitude", "magnitude_low", "magnitude_high", "magnitude_unit", "verdict"),
    )
    (row,) = place.sql(f"SELECT {', '.join(columns)} FROM diagnoses")
    assert row == (
        *("faulty", "motor_2:stuck", "0.99", "0.5", "0.25", "0.75"),
        *("-0.125", "-0.25", "-0.0625", "rad", "motor_2:stuck for sure"),
    )
    assert place.sql("SELECT version, method, protocol FROM sessions") == [
        (ft.__version__, "by hand", "P0c")
    ]
    assert place.sql("SELECT path, sha256, bytes FROM logs") == [
        ("/logs/log_0.csv", a_log(0).sha256, "10")
    ]
    assert place.sql("SELECT at FROM diagnoses")[0][0].startswith("2026-03-02 00:00:00")
    assert place.sql("SELECT name, arm_class FROM profiles") == [("armpi_fpv", "hobby servo")]
    assert place.sql("SELECT kind FROM sensors") == [("tool",)]


def test_a_relative_path_is_that_of_the_folder_at_the_time(tmp_path, monkeypatch):
    """Of a process that works in one folder, then in another."""
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        store = ft.open_store("robots.db", create=True)
        store.remember([diagnosis("run", "healthy")], f"arm_{name}", log=a_log(0))
        monkeypatch.chdir(tmp_path)
        assert len(store.history(f"arm_{name}").recent) == 1
        assert store.name == "robots.db"
    assert (tmp_path / "two" / "robots.db").is_file()


def test_nothing_is_stored_of_nothing(store, place):
    assert store.remember([], "arm_7").added == 0
    assert place.sql("SELECT * FROM robots") == []


def test_the_same_diagnosis_is_stored_once_and_another_of_the_same_run_too(store, place):
    healthy, stuck = diagnosis("run", "healthy"), diagnosis("run", "motor_1:stuck")
    first = store.remember([stuck], "arm_7", log=a_log(0))
    again = store.remember([stuck], "arm_7", log=a_log(0))
    other = store.remember([healthy], "arm_7", log=a_log(0))
    assert [(one.added, one.known) for one in (first, again, other)] == [(1, 0), (0, 1), (1, 0)]
    assert place.sql("SELECT count(*) FROM runs") == [("1",)]
    assert other.episodes == ()  # the run was seen before: it clears nothing
    assert [one.state for one in store.history("arm_7").episodes] == ["raised"]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["healthy", "motor_1:stuck"], [("motor_1", "stuck", "raised", 1, None)]),
        (["motor_1:stuck", "motor_1:stuck"], [("motor_1", "stuck", "raised", 0, None)]),
        (["motor_1:stuck", "healthy"], [("motor_1", "stuck", "cleared", 0, 1)]),
        ([("motor_1:stuck", 0.9)], []),
        (["motor_1:stuck", ("healthy", 0.9)], [("motor_1", "stuck", "raised", 0, None)]),
        (
            ["motor_1:stuck", "motor_1:steady_state_error"],
            [
                ("motor_1", "stuck", "cleared", 0, 1),
                ("motor_1", "steady_state_error", "raised", 1, None),
            ],
        ),
        (
            ["motor_1:stuck", "motor_2:stuck", "healthy"],
            [("motor_1", "stuck", "cleared", 0, 2), ("motor_2", "stuck", "cleared", 1, 2)],
        ),
        (
            ["motor_1:stuck", "healthy", "motor_1:stuck"],
            [("motor_1", "stuck", "cleared", 0, 1), ("motor_1", "stuck", "raised", 2, None)],
        ),
    ],
)
def test_episodes_begin_go_on_and_end_by_the_rule(store, names, expected):
    found = follow(store, *names)
    days = [[t and (t - DAY).days for t in (one.since, one.until)] for one in found]
    told = [(one.motor, one.mode, one.state, *day) for one, day in zip(found, days, strict=True)]
    assert told == expected
    assert [one.number for one in found] == list(range(1, len(expected) + 1))


def test_an_episode_is_suspected_while_only_the_motor_is_certain(store, place):
    shared = diagnosis("run", "motor_1:stuck", 0.6)
    posterior = dict.fromkeys(shared.posterior, 0.005) | {"motor_1:stuck": 0.6}
    posterior["motor_1:steady_state_error"] = 0.385
    shared = replace(shared, posterior=posterior)
    store.remember([shared], "arm_7", log=a_log(0))
    assert store.history("arm_7").episodes[0].state == "suspected"
    store.remember([diagnosis("run", "motor_1:stuck")], "arm_7", log=a_log(1))
    (episode,) = store.history("arm_7").episodes
    assert (episode.state, episode.since) == ("raised", DAY)
    events = place.sql("SELECT state FROM episode_events ORDER BY id")
    assert events == [("suspected",), ("raised",)]


@pytest.mark.parametrize("verdict", ["wrong", "other cause"])
def test_a_finding_hides_no_later_fault(store, verdict):
    """The next sure diagnosis begins an episode of its own, until a person judges that one too."""
    stuck = diagnosis("run", "motor_1:stuck")
    store.remember([stuck], "arm_7", log=a_log(0))
    store.found("arm_7", 1, verdict, cause="a loose cable")
    assert store.history("arm_7").open_episodes == []
    store.remember([stuck], "arm_7", log=a_log(1))
    store.remember([stuck], "arm_7", log=a_log(2))
    found = store.history("arm_7")
    assert [(one.number, one.state) for one in found.episodes] == [(1, "cleared"), (2, "raised")]
    assert [one.number for one in found.open_episodes] == [2]
    assert found.episodes[0].until == found.episodes[1].since == DAY + timedelta(days=1)


def test_a_finding_that_is_withdrawn_leaves_the_episode_as_it_was(store):
    stuck = diagnosis("run", "motor_1:stuck")
    store.remember([stuck], "arm_7", log=a_log(0))
    store.found("arm_7", 1, "wrong")
    store.withdraw("arm_7", 1)
    store.remember([stuck], "arm_7", log=a_log(1))
    assert [one.state for one in store.history("arm_7").episodes] == ["raised"]


def test_an_older_log_is_kept_and_changes_no_episode(store):
    store.remember([diagnosis("run", "motor_1:stuck")], "arm_7", log=a_log(5))
    store.remember([diagnosis("run", "healthy")], "arm_7", log=a_log(1))
    found = store.history("arm_7")
    assert [one.state for one in found.episodes] == ["raised"]
    assert [one.at for one in found.recent] == [DAY + timedelta(days=k) for k in (1, 5)]
    assert [one.state for one in found.recent] == ["healthy", "faulty"]


def test_a_log_of_the_future_is_refused(store):
    ahead = replace(a_log(0), recorded=datetime.now(UTC) + timedelta(days=3))
    with pytest.raises(InputError, match=r"lies in the future.*--recorded"):
        store.remember([diagnosis("run", "healthy")], "arm_7", log=ahead)


def test_findings_count_until_they_are_withdrawn(store, place):
    follow(store, "motor_1:stuck")
    assert store.found("arm_7", 1, "confirmed", cause="gear", person="Ada").state == "confirmed"
    assert store.found("arm_7", 1, "wrong").finding.verdict == "wrong"
    assert store.history("arm_7").open_episodes == []
    assert store.withdraw("arm_7", 1, note="mistaken").finding.verdict == "confirmed"
    assert store.withdraw("arm_7", 1).finding is None
    with pytest.raises(InputError, match="no finding to withdraw"):
        store.withdraw("arm_7", 1)
    rows = place.sql("SELECT verdict, cause, withdraws FROM findings ORDER BY id")
    assert rows == [
        ("confirmed", "gear", ""),
        ("wrong", "", ""),
        ("withdrawn", "", "2"),
        ("withdrawn", "", "1"),
    ]
    assert store.history("arm_7").episodes[0].state == "raised"


def test_an_other_cause_needs_its_name(store):
    follow(store, "motor_1:stuck")
    with pytest.raises(InputError, match="State the cause"):
        store.found("arm_7", 1, "other cause")
    assert store.found("arm_7", 1, "other cause", cause="cable").finding.cause == "cable"
    with pytest.raises(InputError, match="unknown finding 'right'"):
        store.found("arm_7", 1, "right")
    with pytest.raises(InputError, match=r"no episode 2. Its episodes: 1\."):
        store.found("arm_7", 2, "wrong")


def test_repairs_name_motors_of_the_profile(store, place, armpi):
    with pytest.raises(InputError, match="the store is empty"):
        store.repaired("arm_7", "motor_1")
    store.remember([diagnosis("run", "healthy")], "arm_7", log=a_log(0), profile=armpi)
    store.repaired("arm_7", "motor_1", part="servo", person="Ada", at=DAY)
    with pytest.raises(InputError, match="unknown motor 'motor_9'"):
        store.repaired("arm_7", "motor_9")
    assert place.sql("SELECT motor, part, person FROM repairs") == [("motor_1", "servo", "Ada")]
    assert ft.open_store(place.url).history("arm_7").repairs[0].at == DAY


def test_calibrations_follow_each_other_without_a_gap(store, place):
    assert store.calibration("arm_7") is None
    times = [DAY, DAY + timedelta(days=1)]
    for number, time in enumerate(times):
        kept = store.keep_calibration(
            "arm_7", f"x = {number}", name="mine", protocol="P0c", valid_from=time
        )
    same = store.keep_calibration("arm_7", "x = 1", name="mine", protocol="P0c")
    assert same == kept == store.calibration("arm_7")
    first, second = store.history("arm_7").calibrations
    assert (first.valid_from, first.valid_to) == tuple(times)
    assert (second.document, second.valid_to) == ("x = 1", None)
    with pytest.raises(InputError, match="Expected a later time"):
        store.keep_calibration("arm_7", "x = 2", name="mine", protocol="P0c", valid_from=DAY)
    assert place.sql("SELECT count(*) FROM calibrations") == [("2",)]


def test_a_diagnosis_names_the_calibration_it_rests_on(store, place):
    kept = store.keep_calibration("arm_7", "x = 1", name="mine", protocol="P0c")
    store.remember([diagnosis("a", "healthy")], "arm_7", log=a_log(0), calibration=kept.number)
    store.remember([diagnosis("a", "healthy")], "arm_7", log=a_log(0))
    rows = place.sql("SELECT calibration_id FROM sessions ORDER BY id")
    assert rows == [(str(kept.number),), ("",)]
    with pytest.raises(OutputError, match="Nothing of this was stored"):
        store.remember([diagnosis("b", "healthy")], "arm_7", log=a_log(1), calibration=99)
    assert place.sql("SELECT count(*) FROM runs") == [("1",)]


NAMES = (
    *("<script>alert(1)</script>", "Robert'); DROP TABLE robots;--", 'with "quotes" 100 %'),
    *("[bold]a[/bold]", "ärm 機械 🤖", "a:b+c", "%s ? :name $1 {x}"),
)


@pytest.mark.parametrize("name", NAMES)
def test_names_are_only_names(store, place, name):
    store.remember([diagnosis(name, "motor_1:stuck", 0.99)], name, log=a_log(0))
    store.found(name, 1, "confirmed", cause=name, person=name, note=name)
    store.repaired(name, name, part=name)
    found = store.history(name)
    assert (found.robot, found.recent[0].run) == (name, name)
    assert found.episodes[0].finding.cause == found.repairs[0].part == name
    assert place.sql("SELECT name FROM robots") == [(name,)]


@pytest.mark.parametrize("name", ["", "  ", "a\nb", "a\x1b[31m", "a\0", "\ud800"])
def test_names_that_cannot_be_shown_are_refused(store, name):
    with pytest.raises(InputError, match="cannot be shown"):
        store.remember([diagnosis("run", "healthy")], name)


def test_text_that_databases_refuse_is_replaced(store, place):
    odd = "caf\udce9 \0"
    told = diagnosis(odd, "motor_1:stuck", quality=(odd,))
    assert store.remember([told], "arm_7", log=replace(a_log(0), path=odd)).added == 1
    assert store.remember([told], "arm_7", log=replace(a_log(0), path=odd)).known == 1
    assert place.sql("SELECT name FROM runs") == [("caf? \ufffd",)]


def fleet(store, armpi):
    """Remember four robots and what people found."""
    courses = {
        "arm_1": ["motor_1:stuck", "healthy", "motor_1:stuck"],
        "arm_2": ["motor_1:stuck", "healthy"],
        "arm_3": ["motor_2:stuck", "healthy"],
        "arm_4": ["healthy", "healthy", "healthy", "healthy", "healthy"],
    }
    for robot, names in courses.items():
        for day, name in enumerate(names):
            told = [diagnosis("run", name)]
            store.remember(told, robot, log=a_log(day, robot), profile=armpi)
    store.found("arm_1", 1, "confirmed")
    store.found("arm_2", 1, "wrong", person="Ada")
    store.keep_calibration("arm_4", "x = 1", name="mine", protocol="P0c")


def test_questions_are_answered_by_what_is_stored(store, armpi):
    fleet(store, armpi)
    assert store.query("failing-motors").rows == (
        ("armpi_fpv", "motor_1", "stuck", 3, 2, 1, 1),
        ("armpi_fpv", "motor_2", "stuck", 1, 1, 0, 0),
    )
    # Watched: 2 + 1 + 1 + 4 days; the wrong diagnosis is no failure.
    assert store.query("time-between-failures").rows == (
        ("armpi_fpv", "motor_1", 4, 8.0, 2, 4.0),
        ("armpi_fpv", "motor_2", 4, 8.0, 1, 8.0),
    )
    assert store.query("wrong-diagnoses").rows == (
        ("arm_2", 1, DAY, "motor_1:stuck for sure", "wrong", "", "Ada"),
    )
    due = {robot: why for robot, _, why in store.query("due", days=1e5).rows}
    assert due == {
        "arm_1": "open fault, no calibration",
        "arm_2": "no calibration",
        "arm_3": "no calibration",
    }
    assert "arm_4" in [robot for robot, *_ in store.query("due", days=0.0).rows]
    with pytest.raises(InputError, match=r"unknown query 'duo'. Did you mean 'due'"):
        store.query("duo")


@pytest.mark.parametrize("name", QUESTIONS)
def test_an_empty_store_has_answers_without_rows(store, name):
    answer = store.query(name)
    assert answer.rows == ()
    assert answer.columns == QUESTIONS[name].columns


def test_a_robot_without_time_has_no_time_between_failures(store):
    follow(store, "motor_1:stuck")
    assert store.query("time-between-failures").rows == (("", "motor_1", 1, 0.0, 1, None),)


def test_a_log_is_remembered_part_by_part(place, store):
    for _ in range(2):  # the second time all is known
        for first in (0, 3, 6):
            told = [diagnosis(f"run_{k}", "healthy") for k in range(first, min(first + 3, 8))]
            done = store.remember(told, "arm_7", log=a_log(0), first=first)
    assert (done.added, done.known) == (0, 2)
    rows = place.sql("SELECT position, name FROM runs ORDER BY id")
    assert [(int(position), name) for position, name in rows] == [(k, f"run_{k}") for k in range(8)]
    assert store.history("arm_7").counts == {"healthy": 8}


def test_the_history_lists_the_last_runs_and_counts_all(store):
    told = [diagnosis(f"run_{k}", "healthy") for k in range(30)]
    store.remember(told, "arm_7", log=a_log(0))
    store.begin("arm_7", Basis("import"))  # counts nothing
    store.remember([diagnosis("run_30", "motor_1:stuck")], "arm_8")
    store.remember(told[:1], "arm_7", log=a_log(0))  # known before
    found = store.history("arm_7")
    assert found.counts == {"healthy": 30}
    assert [one.run for one in found.recent] == [f"run_{k}" for k in range(10, 30)]
    assert found.health == "no open fault; last run (2026-03-02): healthy"
    with pytest.raises(InputError, match=r"unknown robot 'arm_9'. Did you mean 'arm_8'"):
        store.history("arm_9")


def test_pandas_reads_every_table_of_the_export(store, place, armpi, tmp_path):
    fleet(store, armpi)
    rows = store.export(tmp_path / "tables")
    for table, count in rows.items():
        frame = pd.read_parquet(tmp_path / "tables" / f"{table}.parquet")
        assert place.sql(f"SELECT count(*) FROM {table}") == [(str(len(frame)),)] == [(str(count),)]
    frame = pd.read_parquet(tmp_path / "tables" / "diagnoses.parquet")
    joined = frame.merge(
        pd.read_parquet(tmp_path / "tables" / "robots.parquet"),
        left_on="robot_id",
        right_on="id",
    )
    assert joined[joined.state == "faulty"].name.value_counts().to_dict() == {
        "arm_1": 2,
        "arm_2": 1,
        "arm_3": 1,
    }
    assert str(frame["at"].dtype) == "datetime64[us, UTC]"
    assert json.loads(frame.posterior.iloc[0])["motor_1:stuck"] == 0.99


def test_a_check_names_logs_that_are_missing_or_changed(store, tmp_path):
    files = [tmp_path / f"{name}.csv" for name in ("same", "changed", "missing")]
    for number, file in enumerate(files):
        file.write_text(f"log {number}")
        store.remember([diagnosis("run", "healthy")], "arm_7", log=file)
    assert store.check().problems == ()
    files[1].write_text("another")
    files[2].unlink()
    problems = store.check().problems
    assert problems == (
        f"log {files[1]}: has changed since it was diagnosed",
        f"log {files[2]}: is missing",
    )
    assert store.check().rows["logs"] == 3


def test_the_checksum_of_a_file_is_that_of_sha256sum_and_a_folder_has_one_too(tmp_path):
    folder = tmp_path / "session"
    folder.mkdir()
    (folder / "a.csv").write_text("1")
    assert log_file(folder / "a.csv").sha256 == sha256(b"1").hexdigest()
    before = log_file(folder)
    (folder / "a.csv").rename(folder / "b.csv")
    assert log_file(folder).sha256 != before.sha256
    assert before.size_bytes == 1
    assert log_file(folder, DAY.replace(tzinfo=None)).recorded == DAY
    with pytest.raises(InputError, match=r"nothing\.csv: cannot be read"):
        log_file(tmp_path / "nothing.csv")
