"""Safe reading of foreign files.

Errors of libraries become one-line `InputError`s (`reading`). The size that a file claims is
compared with its real size and the free memory before any allocation (`check_size`). Text from
files is escaped for terminals and spreadsheets (`printable`, `as_cell`).
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
"""Size up to which any file may expand [bytes]."""
EXPANSION = 200
"""Largest ratio of expanded to stored size. Logs at rest shrink by a factor of 50; deflate reaches
1000, Zstandard more in malicious files."""
MEMORY_SHARE = 0.5
"""Share of the free memory that a file may fill; data are copied at least once."""
MEMORY_BYTES = 4_000 * MB
"""Free memory where the system does not report it [bytes]: a small computer."""
TEXT_BYTES = 64 * MB
"""Largest text file, such as a profile or a URDF [bytes]."""


def files_below(folder: Path, pattern: str) -> list[Path]:
    """Return the files in a folder tree whose name matches a pattern.

    Links to folders are followed; a folder that a link leads back to is searched once.
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
    """Turn any error of a library into a one-line InputError.

    Args:
        path: The file.
        kind: Expected kind of file, such as ``a MATLAB file``.
        fix: What to do about it, one sentence.
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
    """Raise InputError for a device or a pipe, which have no end."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError(f"{path}: is a device or a pipe. Expected a file, {kind}.")


def read_text(path: Path, kind: str, fix: str = "") -> str:
    """Return the text of a file."""
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
    """Raise InputError if reading would take more memory than file and machine allow.

    By its own words the file needs `claimed` bytes for `what`, such as ``its arrays``.
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
    """Raise InputError if `what` in the file `where` needs more than a share of the free memory."""
    free = free_bytes()
    if claimed > MEMORY_SHARE * free:
        raise InputError(
            f"{where}: {what} would take {in_bytes(claimed)}, expected half of the "
            f"{in_bytes(free)} of free memory at most. Cut it into parts, or use a machine with "
            "more memory."
        )


def in_bytes(count: float) -> str:
    """Return a number of bytes in a readable unit."""
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
    """Return the memory that is free to this process [bytes]."""
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
"""Unicode categories that change a terminal's state: control characters, marks of writing
direction, lone surrogates, line separators."""
FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""Characters that start a formula in a spreadsheet."""


def printable(text: str) -> str:
    """Return text that is safe for a terminal: harmful characters are escaped."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(_shown(letter) for letter in text)


def _shown(letter: str) -> str:
    if letter in KEPT or unicodedata.category(letter) not in HARMFUL:
        return letter
    return letter.encode("unicode_escape").decode("ascii")


def as_cell(value: object) -> object:
    """Return the value of a CSV cell: text is `printable`, and quoted if it is like a formula."""
    if not isinstance(value, str):
        return value
    return f"'{printable(value)}" if value.startswith(FORMULA) else printable(value)
