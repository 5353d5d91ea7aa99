"""Files of other people: read without harm, or refused in one line that says what to do.

Three thoughts, each in one place: whatever a library raises over a file becomes an `InputError`
(`reading`), what a file claims to hold is compared with its size and the memory there is before
anything is allocated (`check_size`), and text out of files reaches a terminal or a spreadsheet as
text only (`printable`, `as_cell`).
"""

from __future__ import annotations

import errno
import fnmatch
import os
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from failuretwin.core.errors import FailureTwinError, InputError, reason

MB = 1_000_000
LEAST_BYTES = 256 * MB
"""What any file, however small, may unfold to [bytes]."""
EXPANSION = 200
"""A file may unfold to so many times its size: logs at rest shrink by fifty, while deflate reaches
1000 and Zstandard more where a file was made to harm."""
MEMORY_SHARE = 0.5
"""Share of the free memory that a file may fill: what is read is copied once at least."""
MEMORY_BYTES = 4_000 * MB
"""Free memory where the system does not tell [bytes]: that of a small computer."""
TEXT_BYTES = 64 * MB
"""Longest text, such as a profile or a URDF, that is read whole [bytes]."""


def files_below(folder: Path, pattern: str) -> list[Path]:
    """Return the files at or below a folder whose name fits a pattern, links to folders followed.

    A folder that a link leads back to is searched once.
    """
    found, seen = [], set[str]()
    for here, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(here)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        found += [Path(here) / name for name in fnmatch.filter(names, pattern)]
    return found


@contextmanager
def reading(path: Path | str, kind: str, fix: str = "") -> Iterator[None]:
    """Turn whatever a library raises over a broken file into one line.

    Args:
        path: The file.
        kind: What it was read as, such as ``a MATLAB file``.
        fix: What to do about it, one sentence.

    Raises:
        InputError: For any error of a library; errors of this package pass.
    """
    try:
        yield
    except FailureTwinError:
        raise
    # Broken bytes lead libraries anywhere: IndexError, AssertionError, MemoryError, struct.error.
    except Exception as error:
        why = reason(error).rstrip(".")
        there = getattr(error, "errno", None) not in (errno.ENOENT, errno.EACCES)
        read = f"read as {kind}" if there else "read"
        raise InputError(f"{path}: cannot be {read} ({why}). {fix}".rstrip()) from error


def check_is_file(path: Path, kind: str) -> None:
    """Raise InputError for what is there and has no end, such as a device or a pipe."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError(f"{path}: is a device or a pipe. Expected a file, {kind}.")


def read_text(path: Path, kind: str, fix: str = "") -> str:
    """Return the text of a file.

    Raises:
        InputError: If it cannot be read, is no UTF-8, or is longer than such a text can be.
    """
    with reading(path, kind, fix):
        check_is_file(path, kind)
        size = path.stat().st_size
        if size > TEXT_BYTES:
            raise InputError(
                f"{path}: has {in_bytes(size)}, expected {kind} of {in_bytes(TEXT_BYTES)} at most. "
                "Check the name of the file."
            )
        return path.read_text(encoding="utf-8")


def check_size(claimed: float, path: Path, what: str) -> None:
    """Raise InputError if more would be allocated than the file and the machine can mean.

    Args:
        claimed: Bytes that reading takes, by what the file says of itself.
        path: The file, or a folder of files.
        what: What takes them, such as ``its arrays``.
    """
    stored = stored_bytes(path)
    if claimed > max(LEAST_BYTES, EXPANSION * stored):
        raise InputError(
            f"{path}: {what} would take {in_bytes(claimed)}, and it has {in_bytes(stored)}. "
            f"Expected {EXPANSION} times its size at most, or {in_bytes(LEAST_BYTES)}. It is "
            "damaged or made to do harm: fetch or write it again."
        )
    check_memory(claimed, str(path), what)


def check_memory(claimed: float, where: str, what: str) -> None:
    """Raise InputError if something would take more than a share of the memory that is free.

    Args:
        claimed: Bytes that it takes.
        where: The file, for the error text.
        what: What takes them.
    """
    free = free_bytes()
    if claimed > MEMORY_SHARE * free:
        raise InputError(
            f"{where}: {what} would take {in_bytes(claimed)}, expected half of the "
            f"{in_bytes(free)} of free memory at most. Cut it into parts, or use a machine with "
            "more memory."
        )


def in_bytes(count: float) -> str:
    """Return a number of bytes as people write it."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}" if count < 1e15 else f"{count / size:.0e} {unit}"
    return f"{count:.0f} bytes"


def stored_bytes(path: Path) -> int:
    """Return the size of a file, or of all files in a folder [bytes]; 0 where there is none."""
    if path.is_dir():
        return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    return path.stat().st_size if path.is_file() else 0


def free_bytes() -> float:
    """Return the memory that this process may still take [bytes]."""
    return min(_free_of_machine(), _limit_of_process())


def _free_of_machine() -> float:
    with suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return 1024.0 * float(line.split()[1])
    with suppress(OSError, ValueError, AttributeError):
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    return MEMORY_BYTES


def _limit_of_process() -> float:
    try:
        import resource
    except ImportError:  # Windows
        return float("inf")
    limits = [resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA)]
    return min(float(n) if n != resource.RLIM_INFINITY else float("inf") for n in limits)


# Text out of files: names of runs, joints, motors and topics, and what libraries quote of them.

KEPT = "\n\t"
HARMFUL = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Unicode categories that a terminal acts on instead of showing: control characters, marks that
turn the direction of writing, halves of pairs, and separators of lines."""
FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""What a spreadsheet takes for the beginning of a formula."""


def printable(text: str) -> str:
    """Return text as a terminal may be given it: what it would act on is written out in letters."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(_shown(letter) for letter in text)


def _shown(letter: str) -> str:
    if letter in KEPT or unicodedata.category(letter) not in HARMFUL:
        return letter
    return letter.encode("unicode_escape").decode("ascii")


def as_cell(value: object) -> object:
    """Return what goes into a cell of a CSV file.

    Text becomes `printable`; where it looks like a formula it gets a ``'``.
    """
    if not isinstance(value, str):
        return value
    return f"'{printable(value)}" if value.startswith(FORMULA) else printable(value)
