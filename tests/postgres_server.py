"""A PostgreSQL server for tests: a cluster of its own on a unix socket, without a network."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

USER = "failuretwin"
REQUIRE = "FAILURETWIN_REQUIRE_POSTGRES"
"""Variable that makes tests fail where there is no server to start."""


def server_programs() -> Path | None:
    """Return the folder of the newest server's programs; None: not installed."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    on_path = shutil.which("initdb")
    programs = found[-1] if found else on_path and Path(on_path)
    return Path(programs).parent if programs else None


def need_postgres() -> Path:
    """Return the folder of the server's programs, or skip the test."""
    programs = server_programs()
    if programs is None:
        reason = "no PostgreSQL server here; install the package `postgresql`"
        if os.environ.get(REQUIRE):
            pytest.fail(reason)
        pytest.skip(reason)
    return programs


class PostgresServer:
    """A server with an empty cluster; the superuser of the system starts it as somebody else."""

    def __init__(self):
        self._programs = need_postgres()
        self.folder = Path(tempfile.mkdtemp(prefix="failuretwin_pg_"))
        self._as_other = []
        if os.geteuid() == 0:
            other = next(
                n for n in ("postgres", "nobody") if n in {u.pw_name for u in pwd.getpwall()}
            )
            shutil.chown(self.folder, other)
            self._as_other = ["runuser", "-u", other, "--"]
        self._databases = 0

    def run(self, program, *words):
        """Run one of the server's programs and return what it says."""
        call = [*self._as_other, str(self._programs / program), *map(str, words)]
        done = subprocess.run(call, capture_output=True, text=True, cwd=self.folder)
        assert done.returncode == 0, (call, done.stdout, done.stderr)
        return done.stdout

    def start(self):
        """Make the cluster and start the server."""
        cluster = self.folder / "cluster"
        self.run("initdb", "-D", cluster, "-U", USER, "-A", "trust", "-E", "UTF8", "--no-sync")
        self._options = f"-c listen_addresses='' -c fsync=off -k {self.folder}"
        self.restart()

    def restart(self):
        """Start the server of the cluster."""
        log = self.folder / "log"
        words = ("-D", self.folder / "cluster", "-l", log, "-o", self._options, "-w", "start")
        # The server keeps the pipes of its parent open, so it gets none.
        call = [*self._as_other, str(self._programs / "pg_ctl"), *map(str, words)]
        subprocess.run(call, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def stop(self):
        """Stop the server at once, as by a lost connection."""
        self.run("pg_ctl", "-D", self.folder / "cluster", "-m", "immediate", "-w", "stop")

    @contextmanager
    def full_disk(self, size):
        """Let no file of new connections grow beyond a size in bytes, as on a disk that is full.

        It must be above that of a WAL segment, 16 MiB.
        """
        process = (self.folder / "cluster" / "postmaster.pid").read_text().split()[0]
        limit = [*self._as_other, "prlimit", "--pid", process]
        subprocess.run([*limit, f"--fsize={size}:"], check=True)
        try:
            yield
        finally:
            subprocess.run([*limit, "--fsize=unlimited:"], check=True)

    def close(self):
        """Stop the server and remove the cluster."""
        self.stop()
        shutil.rmtree(self.folder)

    def place(self):
        """Make an empty database and return a place for a store."""
        return PostgresPlace(self, self._database())

    def _database(self):
        self._databases += 1
        name = f"store_{self._databases}"
        self.run("createdb", "-h", self.folder, "-U", USER, name)
        return f"postgresql://{USER}@/{name}?host={self.folder}"

    def sql(self, url, statement):
        """Run SQL by `psql`, and return the rows, cells joined by `|`."""
        name = url.partition("@/")[2].partition("?")[0]
        words = ("-h", self.folder, "-U", USER, "-d", name, "-At", "-v", "ON_ERROR_STOP=1")
        return self.run("psql", *words, "-c", statement).splitlines()


class PostgresPlace:
    """A database for a store, and SQL by `psql`."""

    engine = "postgresql"

    def __init__(self, server, url):
        self.url = url
        self.server = server

    def sql(self, statement):
        """Run SQL and return rows of texts; an empty text is null."""
        return [tuple(row.split("|")) for row in self.server.sql(self.url, statement)]
