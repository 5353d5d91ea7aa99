"""The store when things go wrong: two writers, full disks, other schemas, other programs."""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import failuretwin as ft
from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.hypothesis import MotorResidual
from failuretwin.data_knowledge.records import migrations, writing
from failuretwin.data_knowledge.records.beliefs import Belief, BeliefLine
from failuretwin.data_knowledge.records.database import Database
from failuretwin.data_knowledge.records.offsets import MotorOffset
from failuretwin.data_knowledge.records.schema import CLOSES, Basis, metadata
from failuretwin.data_knowledge.records.sessions import Note
from full_disks import full_disk
from killed_writers import in_a_child
from store_places import diagnosis

NOW = datetime(2026, 3, 2, tzinfo=UTC)
TABLES = [table.name for table in metadata.sorted_tables]


@pytest.fixture
def store(place):
    return ft.open_store(place.url, create=True)


def remember(store, robot="arm_7", count=1, name="motor_1:stuck"):
    return store.remember([diagnosis(f"run_{k}", name) for k in range(count)], robot)


def contents(place):
    """Return all rows of all tables, by the engine's own program."""
    return {table: place.sql(f"SELECT * FROM {table} ORDER BY id") for table in TABLES}


# The schema.


def test_the_migrations_make_the_tables_of_the_schema(place, store):
    with Database(place.url).reading() as connection:
        context = MigrationContext.configure(connection)
        assert compare_metadata(context, metadata) == []


def test_every_revision_leads_to_the_head():
    assert migrations.revisions()[-1] == migrations.HEAD


def test_a_store_that_is_up_to_date_stays_as_it_is(place, store):
    remember(store, count=2)
    before = contents(place)
    assert Database(place.url).upgrade() == (migrations.HEAD, migrations.HEAD)
    assert contents(place) == before
    with pytest.raises(Exception, match="append-only"):
        refused(place, "DELETE FROM robots")


def test_an_older_store_gets_the_newer_tables(place, store):
    remember(store)
    place.sql("DROP TABLE withdrawals")
    place.sql("UPDATE alembic_version SET version_num = '5'")
    assert Database(place.url).upgrade() == ("5", migrations.HEAD)
    with Database(place.url).reading() as connection:
        assert compare_metadata(MigrationContext.configure(connection), metadata) == []
    assert len(place.sql("SELECT * FROM runs")) == 1
    with pytest.raises(Exception, match="append-only"):
        refused(place, "DELETE FROM runs")


def refused(place, statement):
    """Run SQL that must fail, and raise its error."""
    try:
        place.sql(statement)
    except (AssertionError, sqlite3.Error) as error:
        raise ValueError(str(error)) from error


def test_a_newer_schema_needs_a_newer_package(place, store):
    place.sql("UPDATE alembic_version SET version_num = '99'")
    for call in (lambda: ft.open_store(place.url), Database(place.url).upgrade):
        with pytest.raises(InputError, match=r"revision '99'.*Install a newer failuretwin"):
            call()


def test_other_databases_are_left_alone(place):
    place.sql("CREATE TABLE notes (id INTEGER)")
    for create in (False, True):
        with pytest.raises(InputError, match=r"other tables, expected a store"):
            ft.open_store(place.url, create=create)
    with pytest.raises((sqlite3.Error, AssertionError), match="robots"):
        place.sql("SELECT * FROM robots")


# Append-only.


def column_of(table):
    return st.sampled_from([column.name for column in metadata.tables[table].columns])


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
@given(data=st.data())
def test_no_program_changes_or_deletes_evidence(full_place, data):
    table = data.draw(st.sampled_from(TABLES))
    column = data.draw(column_of(table).filter(lambda name: name not in ("id", CLOSES.get(table))))
    changes = [f"DELETE FROM {table}", f"UPDATE {table} SET {column} = NULL"]
    changes.append(f"UPDATE {table} SET id = id + 1")
    rows = f"SELECT * FROM {table}"
    before = full_place.sql(rows)
    with pytest.raises(ValueError, match="append-only"):
        refused(full_place, data.draw(st.sampled_from(changes)))
    assert full_place.sql(rows) == before


@pytest.fixture
def full_place(place, store, armpi):
    """A store with a row in every table."""
    kept = store.keep_calibration("arm_7", "x = 1", name="c", protocol="P0c", profile=armpi)
    residual = MotorResidual("motor_1", "rad", (0.1,), (0.01,), (0.5,), (1.0,))
    told = diagnosis("run", "motor_1:stuck", residual=residual)
    store.remember([told], "arm_7", calibration=kept.number)
    store.found("arm_7", 1, "confirmed")
    store.repaired("arm_7", "motor_1")
    store.withdraw_repair("arm_7", "motor_1")
    store.begin("arm_7", Basis("act"), Note(NOW, "target 1: reached"))
    zero = MotorOffset("motor_1", "zero", 0.1, 0.01, "rad")
    belief = Belief(1, {"mean": np.arange(3.0)}, [{"key": "a"}])
    store.keep_belief("arm_7", Basis("track"), BeliefLine("diagnose", "cold"), belief, NOW, [zero])
    assert all(contents(place).values())
    return place


@pytest.mark.parametrize(("table", "end"), CLOSES.items())
def test_an_interval_is_closed_once(full_place, table, end):
    full_place.sql(f"UPDATE {table} SET {end} = '2026-03-03 00:00:00'")
    with pytest.raises(ValueError, match="append-only"):
        refused(full_place, f"UPDATE {table} SET {end} = '2026-03-04 00:00:00'")
    with pytest.raises(ValueError, match="append-only"):
        refused(full_place, f"UPDATE {table} SET {end} = NULL")


def test_rows_are_not_replaced_or_truncated(full_place):
    row = "(1, 'another', '2026-03-02 00:00:00')"
    if full_place.engine == "sqlite":
        statement = f"INSERT OR REPLACE INTO robots VALUES {row}"
    else:
        statement = "TRUNCATE robots CASCADE"
    with pytest.raises(ValueError, match="append-only"):
        refused(full_place, statement)
    assert full_place.sql("SELECT name FROM robots") == [("arm_7",)]


# Deaths and writers at once.


def test_a_process_that_dies_while_writing_leaves_nothing(place, store):
    remember(store)
    before = contents(place)

    def die():
        with Database(place.url).writing() as connection:
            connection.execute(sa.text("INSERT INTO robots VALUES (9, 'half', '2026-03-02')"))
            os._exit(0)

    os.waitpid(in_a_child(die), 0)
    assert contents(place) == before
    assert remember(store, "arm_8").added == 1


def test_two_writers_and_a_reader_at_once_lose_nothing(place, store):
    remember(store, "arm_0", name="healthy")
    errors = []

    def write(writer):
        try:
            mine = ft.open_store(place.url)
            for turn in range(15):
                remember(mine, "arm_7", name="healthy" if turn % 2 else "motor_1:stuck")
        except Exception as error:
            errors.append(error)

    def read():
        for _ in range(15):
            found = ft.open_store(place.url).history("arm_0")
            errors.extend([found] if found.counts != {"healthy": 1} else [])

    threads = [threading.Thread(target=write, args=(k,)) for k in range(2)]
    threads.append(threading.Thread(target=read))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert place.sql("SELECT count(*) FROM diagnoses") == [("31",)]
    assert sum(store.history("arm_7").counts.values()) == 30
    numbers = [int(row[0]) for row in place.sql("SELECT number FROM episodes ORDER BY id")]
    assert sorted(numbers) == list(range(1, len(numbers) + 1))
    still_open = place.sql("SELECT count(*) FROM episodes WHERE until IS NULL")
    assert still_open in ([("0",)], [("1",)])


def test_stores_made_at_once_are_one_store(place):
    children = [in_a_child(lambda: ft.open_store(place.url, create=True)) for _ in range(3)]
    for child in children:
        os.waitpid(child, 0)
    assert place.sql("SELECT version_num FROM alembic_version") == [(migrations.HEAD,)]
    assert remember(ft.open_store(place.url)).added == 1


# Clear errors.


@pytest.fixture
def file(tmp_path):
    return tmp_path / "robots.db"


def test_a_locked_file_gives_one_line(file, monkeypatch):
    store = ft.open_store(file, create=True)
    monkeypatch.setattr("failuretwin.data_knowledge.records.database.PATIENCE_S", 0.05)
    impatient = ft.open_store(file)
    holder = sqlite3.connect(file, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    with pytest.raises(OutputError, match=r"another program.*Nothing of this was stored") as said:
        remember(impatient)
    assert "\n" not in str(said.value)
    holder.execute("ROLLBACK")
    holder.close()
    assert remember(store).added == 1


def test_a_full_disk_gives_one_line_and_loses_nothing(file):
    store = ft.open_store(file, create=True)
    remember(store)
    size = file.stat().st_size
    with (
        full_disk(size),
        pytest.raises(OutputError, match=r"disk is full.*Nothing of this") as said,
    ):
        remember(store, "arm_8", count=2000)
    assert "\n" not in str(said.value)
    assert store.robots() == ["arm_7"]
    assert store.check().problems == ()
    assert remember(store, "arm_8", count=2000).added == 2000


WIDE = 1500
"""Length of a name that no page of full ones has room for."""


@pytest.mark.skipif(shutil.which("prlimit") is None, reason="prlimit (util-linux) is missing")
def test_a_full_disk_of_a_server_gives_one_line_and_loses_nothing(postgres):
    """Files of the server may not grow beyond the table of runs."""
    place = postgres.place()
    store = ft.open_store(place.url, create=True)
    remember(store)
    fill = f"SELECT 1, number, repeat('x', {WIDE}) FROM generate_series(1, 14000) AS number"
    place.sql(f"INSERT INTO runs (log_id, position, name) {fill}")
    ((size,),) = place.sql("SELECT pg_relation_size('runs')")
    given = [diagnosis(str(k) + WIDE * "y", "healthy") for k in range(50)]
    with (
        postgres.full_disk(int(size)),
        pytest.raises(OutputError, match=r"disk is full.*Nothing of this") as said,
    ):
        store.remember(given, "arm_8")
    assert "\n" not in str(said.value)
    assert store.robots() == ["arm_7"]
    assert store.remember(given, "arm_8").added == 50


def test_a_connection_that_is_lost_in_a_call_gives_one_line_and_loses_nothing(
    postgres, monkeypatch
):
    place = postgres.place()
    store = ft.open_store(place.url, create=True)
    remember(store)
    before, add = contents(place), writing.add_diagnoses

    def lose(*given):
        place.sql(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
            "WHERE datname = current_database() AND pid <> pg_backend_pid()"
        )
        return add(*given)

    with monkeypatch.context() as patch:
        patch.setattr(writing, "add_diagnoses", lose)
        with pytest.raises(OutputError, match=r"Nothing of this was stored\. Check that") as said:
            remember(store, "arm_8")
    assert "\n" not in str(said.value)
    assert contents(place) == before
    assert remember(store, "arm_8").added == 1


def test_a_store_is_not_made_on_a_full_disk(file):
    with full_disk(4096), pytest.raises(OutputError, match="disk is full"):
        ft.open_store(file, create=True)
    assert list(file.parent.iterdir()) == []


NOBODY = 65534


@pytest.fixture
def open_folder():
    """A folder that everybody can read."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


@pytest.mark.skipif(os.geteuid() != 0, reason="only the superuser can become somebody else")
@pytest.mark.parametrize(
    ("mode", "said"), [(0o755, "cannot be (written|opened)"), (0o777, "cannot be written")]
)
def test_a_file_that_may_not_be_written_gives_one_line(open_folder, mode, said):
    file = open_folder / "robots.db"
    ft.open_store(file, create=True)
    open_folder.chmod(mode)
    answer, told = os.pipe()

    def as_nobody():
        os.setuid(NOBODY)
        try:
            remember(ft.open_store(file))
        except (InputError, OutputError) as error:
            os.write(told, str(error).encode())

    os.waitpid(in_a_child(as_nobody), 0)
    os.close(told)
    with os.fdopen(answer) as pipe:
        line = pipe.read()
    assert re.fullmatch(rf".*robots.db: it {said}.*", line)
    assert ft.open_store(file).robots() == []


@pytest.mark.parametrize(
    ("url", "said"),
    [
        (
            "nothing.db",
            r"does not exist. Make it first: failuretwin store init --store nothing\.db",
        ),
        ("mysql://u@h/d", r"kind 'mysql' is not supported. Expected the path of an SQLite file"),
        ("postgresql://", "names no database"),
        ("", "names no database"),
        ("sqlite://", "names no database"),
        (":memory:", "names no database"),
        ("http://u@h/d", "kind 'http' is not supported"),
        ("://d", "URL cannot be read"),
        ("postgresql://u:secret@127.0.0.1:9/d", r"u:\*\*\*@127.0.0.1:9/d: connection failed"),
    ],
)
def test_a_wrong_url_gives_one_line(url, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=said) as error:
        ft.open_store(url)
    assert "\n" not in str(error.value)
    assert "secret" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_folders_and_other_files_are_no_stores(tmp_path):
    with pytest.raises(InputError, match="is a folder"):
        ft.open_store(tmp_path)
    (tmp_path / "notes.txt").write_text("notes, and more of them than the head of a database " * 9)
    with pytest.raises((InputError, OutputError), match="not an SQLite database"):
        ft.open_store(tmp_path / "notes.txt", create=True)
    assert (tmp_path / "notes.txt").read_text().startswith("notes")
    (tmp_path / "empty.db").touch()
    with pytest.raises(InputError, match="holds no store yet"):
        ft.open_store(tmp_path / "empty.db")


def test_damage_is_reported(file):
    store = ft.open_store(file, create=True)
    remember(store, count=300)
    content = bytearray(file.read_bytes())
    content[-4096:] = bytes(4096)
    file.write_bytes(content)
    try:
        problems = store.check().problems
    except InputError as error:
        problems = (str(error),)
    assert problems


def test_a_lost_server_gives_one_line_and_loses_nothing(postgres):
    place = postgres.place()
    store = ft.open_store(place.url, create=True)
    remember(store)
    postgres.stop()
    try:
        with pytest.raises(OutputError, match=r"Nothing of this was stored. Check that") as said:
            remember(store, "arm_8")
        assert "\n" not in str(said.value)
        with pytest.raises(InputError, match="Check that the server runs"):
            store.history("arm_7")
    finally:
        postgres.restart()
    assert store.robots() == ["arm_7"]
    assert remember(store, "arm_8").added == 1


def test_without_the_libraries_the_extra_is_named():
    code = (
        "import sys; sys.modules['sqlalchemy'] = None\n"
        "import failuretwin as ft\n"
        "try: ft.open_store\n"
        "except ft.InputError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.endswith("Install them: pip install 'failuretwin[store]'.\n")
