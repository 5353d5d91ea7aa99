"""Speed of the store: rows a second in, bytes a run, history and ready questions.

    python benchmarks/records.py [--url URL] [--runs 100000] [--robots 20] [--calls 50] [--copies 0]

Without --url: an SQLite file in a temporary folder. A log holds 100 runs; each robot has a fault
now and then, and half of the faults are confirmed. History and questions are asked CALLS times,
each from a store that has just been opened; the table states median and 99 % quantile.

--copies N multiplies what was filled: the rows are copied N times by SQL, later and with identities
of their own (PostgreSQL: as superuser, without the checks of references).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

import failuretwin as ft
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.records.database import Database
from failuretwin.data_knowledge.records.log_files import LogFile
from failuretwin.data_knowledge.records.queries import QUESTIONS
from failuretwin.data_knowledge.records.schema import Utc, metadata

LOG_RUNS = 100
FAULT_SHARE = 0.02
"""Share of logs that end with a fault."""
START = datetime(2020, 1, 1, tzinfo=UTC)


def main() -> None:
    """Fill a store and time what it answers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--url")
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--calls", type=int, default=50)
    parser.add_argument("--copies", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        url = options.url or str(Path(folder) / "robots.db")
        store = ft.open_store(url, create=True)
        fill(store, options.runs, options.robots)
        if options.copies:
            copy(url, options.copies)
        measure(url, options.runs * (1 + options.copies), options.robots, options.calls)
        begun = time.perf_counter()
        rows = sum(store.export(Path(folder) / "tables").values())
        print(f"export: {rows / (time.perf_counter() - begun):,.0f} rows a second")


def measure(url: str, runs: int, robots: int, calls: int) -> None:
    """Print the size of a store, and the times of its answers."""
    size = stored_bytes(url)
    print(f"bytes a run: {size / runs:.0f} ({size / 1e6:.0f} MB)")
    report("history", calls, lambda: ft.open_store(url).history(f"arm_{robots - 1}"))
    for name in QUESTIONS:
        report(name, calls, partial(answered, url, name))


def fill(store: ft.Store, runs: int, robots: int) -> None:
    """Remember runs, log by log, the robots in turn, and print rows a second.

    The last robot gets half of all runs.
    """
    rng, robot = np.random.default_rng(0), ft.load_robot("armpi_fpv")
    busy, spent_s = 0.0, []
    for log in range(runs // LOG_RUNS):
        name = f"arm_{robots - 1 if log % 2 else (log // 2) % robots}"
        diagnoses = day(rng, robot.motor_names)
        source = LogFile(f"/logs/{log}.nc", f"{log:064x}", 10_000, START + timedelta(hours=log))
        begun = time.perf_counter()
        done = store.remember(diagnoses, name, log=source, profile=robot)
        for episode in done.episodes:
            if episode.until is None and rng.random() < 0.5:
                store.found(name, episode.number, "confirmed")
        spent_s.append(time.perf_counter() - begun)
        busy += spent_s[-1]
    count = runs // LOG_RUNS * LOG_RUNS
    middle, worst = (1e3 * np.quantile(spent_s, q) for q in (0.5, 0.99))
    print(f"in: {count / busy:,.0f} runs a second, a run and a diagnosis each")
    print(f"a log of {LOG_RUNS} runs: median {middle:.0f} ms, 99 % {worst:.0f} ms")


def day(rng: np.random.Generator, motors: list[str]) -> list[ft.Diagnosis]:
    """Return the diagnoses of a log: healthy, or faulty at its end."""
    names = [str(one) for one in paper_hypotheses(motors)]
    faulty = rng.integers(1, len(names)) if rng.random() < FAULT_SHARE else 0
    found = []
    for run in range(LOG_RUNS):
        true = faulty if run >= LOG_RUNS // 2 else 0
        posterior = np.full(len(names), 0.01 / (len(names) - 1))
        posterior[true] = 0.99
        table = dict(zip(names, posterior.tolist(), strict=True))
        found.append(ft.Diagnosis(f"run_{run}", table, onset_s=0.5, verdict=f"{names[true]}, 99 %"))
    return found


COPIED = ("logs", "runs", "sessions", "diagnoses", "episodes", "episode_events", "findings")
"""Tables that grow with the runs, each behind those that it refers to."""
TOTALS = """
CREATE TEMP TABLE totals AS SELECT robot_id, diagnosed FROM sessions
WHERE id IN (SELECT max(id) FROM sessions GROUP BY robot_id)
"""
COUNTS = """(
    SELECT AGGREGATE(key, CAST(value AS BIGINT) + COPY * CAST(totals.diagnosed ->> key AS BIGINT))
    FROM totals, EACH(sessions.diagnosed) WHERE totals.robot_id = sessions.robot_id
)"""
"""What a session counts, after all runs of the copies before it."""
SQLITE = {"AGGREGATE": "json_group_object", "EACH": "json_each"}
POSTGRES = {"AGGREGATE": "jsonb_object_agg", "EACH": "jsonb_each"}


def copy(url: str, copies: int) -> None:
    """Copy the rows of a store by SQL, each time later, and print rows a second."""
    begun, database = time.perf_counter(), Database(url)
    at = metadata.tables["diagnoses"].c.at
    with database.writing() as connection:
        tell = connection.exec_driver_sql
        tell("UPDATE episodes SET until = since WHERE until IS NULL")
        if database.file is None:
            tell("SET LOCAL session_replication_role = replica")
        tell(TOTALS)
        last = {name: int(tell(f"SELECT max(id) FROM {name}").scalar() or 0) for name in COPIED}
        first, end = connection.execute(sa.select(sa.func.min(at), sa.func.max(at))).one()
        span_s = (end - first).total_seconds() + 3600.0
        for number in range(1, copies + 1):
            for name in COPIED:
                given = (number, number * span_s, database.file is not None)
                tell(copying(metadata.tables[name], last, *given))
        for name in COPIED if database.file is None else ():
            tell(f"SELECT setval('{name}_id_seq', (SELECT max(id) FROM {name}))")
    spent = time.perf_counter() - begun
    print(f"copied: {copies * last['runs'] / spent:,.0f} runs a second")


def copying(
    table: sa.Table, last: Mapping[str, int], number: int, later_s: float, sqlite: bool
) -> str:
    """Return the statement that copies the first rows of a table with identities of their own."""

    def cell(column: sa.Column[Any]) -> str:
        own = f"{table.name}.{column.name}"
        refers = [key.column.table.name for key in column.foreign_keys]
        target = table.name if column.name == "id" else next(iter(refers), "")
        if column.name == "number":
            target = "episodes"
        if target in last:
            return f"{own} + {number * last[target]}"
        if isinstance(column.type, Utc):
            later = f"strftime('%Y-%m-%d %H:%M:%f000', {own}, '+{later_s:.0f} seconds')"
            return later if sqlite else f"{own} + interval '{later_s:.0f} seconds'"
        if column.name == "diagnosed":
            counts = COUNTS.replace("COPY", str(number))
            for name, function in (SQLITE if sqlite else POSTGRES).items():
                counts = counts.replace(name, function)
            return counts
        if column.name == "sha256":
            return f"'{'c' * 56}' || CAST({table.name}.id + {number * last[table.name]} AS TEXT)"
        return own

    cells, names = ", ".join(map(cell, table.columns)), ", ".join(table.columns.keys())
    rows = f"SELECT {cells} FROM {table.name} WHERE id <= {last[table.name]}"
    return f"INSERT INTO {table.name} ({names}) {rows}"


def answered(url: str, question: str) -> object:
    """Return the answer to a question from a store that has just been opened."""
    return ft.open_store(url).query(question)


def stored_bytes(url: str) -> int:
    """Return the size of a store [bytes]."""
    database = Database(url)
    if database.file is not None:
        return sum(file.stat().st_size for file in database.file.parent.glob("robots.db*"))
    with database.reading() as connection:
        size = sa.func.pg_database_size(sa.func.current_database())
        return int(connection.scalar(sa.select(size)) or 0)


def report(name: str, calls: int, work: Callable[[], object]) -> None:
    """Call something, and print its median and 99 % quantile."""
    spent_ms = []
    for _ in range(calls):
        begun = time.perf_counter()
        work()
        spent_ms.append(1e3 * (time.perf_counter() - begun))
    middle, worst = np.quantile(spent_ms, [0.5, 0.99])
    print(f"{name}: median {middle:.0f} ms, 99 % {worst:.0f} ms")


if __name__ == "__main__":
    main()
