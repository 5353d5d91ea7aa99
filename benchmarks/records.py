"""Speed of the store: rows a second in, bytes a run, history and ready questions.

    python benchmarks/records.py [--url URL] [--runs 100000] [--robots 20] [--calls 50]

Without --url: an SQLite file in a temporary folder. A log holds 100 runs; each robot has a fault
now and then, and half of the faults are confirmed. History and questions are asked CALLS times,
each from a store that has just been opened; the table states median and 99 % quantile.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np
import sqlalchemy as sa

import failuretwin as ft
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.records.database import Database
from failuretwin.data_knowledge.records.log_files import LogFile
from failuretwin.data_knowledge.records.queries import QUESTIONS

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
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        url = options.url or str(Path(folder) / "robots.db")
        store = ft.open_store(url, create=True)
        fill(store, options.runs, options.robots)
        size = stored_bytes(url)
        print(f"bytes a run: {size / options.runs:.0f} ({size / 1e6:.0f} MB)")
        last = f"arm_{options.robots - 1}"
        report("history", options.calls, lambda: ft.open_store(url).history(last))
        for name in QUESTIONS:
            report(name, options.calls, partial(answered, url, name))
        begun = time.perf_counter()
        rows = sum(store.export(Path(folder) / "tables").values())
        print(f"export: {rows / (time.perf_counter() - begun):,.0f} rows a second")


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
