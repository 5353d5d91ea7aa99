"""Places for stores in tests, looked at without the package, and diagnoses to put there."""

from __future__ import annotations

import sqlite3
from contextlib import closing

from failuretwin.core.hypothesis import Diagnosis

MODES = ("stuck", "steady_state_error")
NAMES = ("healthy", *(f"motor_{k}:{mode}" for mode in MODES for k in (1, 2)))


class SqlitePlace:
    """A file for a store, and SQL by Python's own module."""

    engine = "sqlite"

    def __init__(self, file):
        self.url = str(file)
        self.file = file

    def sql(self, statement):
        """Run SQL and return rows of texts; an empty text is null."""
        with closing(sqlite3.connect(self.file)) as connection:
            connection.execute("PRAGMA foreign_keys=ON")
            rows = connection.execute(statement).fetchall()
            connection.commit()
        return [tuple("" if cell is None else str(cell) for cell in row) for row in rows]


def diagnosis(run, name, probability=0.99, **more):
    """Return a diagnosis of a probable hypothesis; the others share the rest."""
    rest = (1.0 - probability) / (len(NAMES) - 1)
    posterior = {one: probability if one == name else rest for one in NAMES}
    return Diagnosis(run, posterior, verdict=f"{name} for sure", method="by hand", **more)
