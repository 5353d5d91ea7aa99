"""Put something new where something old stands, in one step where the system can."""

from __future__ import annotations

import ctypes
import os
import shutil
from pathlib import Path

AT_FDCWD = -100
RENAME_EXCHANGE = 2


def take_place(new: Path, path: Path) -> None:
    """Put `new` where `path` is; a folder there is kept until the new one stands.

    Raises:
        OSError: If that cannot be done; `path` is as before.
    """
    if not path.is_dir():
        new.replace(path)
        return
    if exchange(new, path):
        shutil.rmtree(new)
        return
    old = path.with_name(f".{path.name}.{os.getpid()}.old")
    path.replace(old)
    try:
        new.replace(path)
    except OSError:
        old.replace(path)
        raise
    shutil.rmtree(old)


def exchange(one: Path, other: Path) -> bool:
    """Let two paths change places in one step; return False where the system cannot.

    Without it a process that is killed between two renames would leave no folder at all.
    """
    try:
        rename = ctypes.CDLL(None).renameat2
    except (AttributeError, OSError):
        return False
    names = (os.fsencode(one), os.fsencode(other))
    done: int = rename(AT_FDCWD, names[0], AT_FDCWD, names[1], RENAME_EXCHANGE)
    return done == 0
