"""One writer at a time: a lock that ends with the process that holds it."""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from failuretwin.core.errors import OutputError


@contextmanager
def sole_writer(path: Path) -> Iterator[None]:
    """Hold the lock `.NAME.lock` beside `path`; nobody else can write `path` meanwhile.

    The system lets go of the lock when its process dies, however that happens, so the file of a
    dead process holds nobody back.

    Raises:
        OutputError: If another process holds it, or if it cannot be made.
    """
    file = path.with_name(f".{path.name}.lock")
    handle = _locked(file, path)
    try:
        yield
    finally:
        file.unlink(missing_ok=True)  # before letting go: nobody can lock a file that has no name
        os.close(handle)


def _locked(file: Path, path: Path) -> int:
    while True:
        try:
            handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise OutputError(f"{path}: lock {file} cannot be made ({error.strerror}).") from error
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = os.read(handle, 200).decode(errors="replace")
            os.close(handle)
            raise OutputError(
                f"{path}: {holder or 'another process'} is writing it. Wait until it is done, or "
                "choose another name."
            ) from error
        if _still_there(file, handle):
            _write_holder(handle)
            return handle
        os.close(handle)  # the one before us removed it just as we came


def _still_there(file: Path, handle: int) -> bool:
    try:
        return os.path.samestat(file.stat(), os.fstat(handle))
    except FileNotFoundError:
        return False


def _write_holder(handle: int) -> None:
    """Say who holds the lock; on a full disk it goes without a name."""
    try:
        os.truncate(handle, 0)
        os.write(handle, f"process {os.getpid()} on {socket.gethostname()}".encode())
    except OSError:
        pass
