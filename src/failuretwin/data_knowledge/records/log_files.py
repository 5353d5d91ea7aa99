"""Logs by reference: path, checksum, size and time."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from failuretwin.core.errors import InputError, reason


@dataclass(frozen=True)
class LogFile:
    """A log that runs were read from.

    Attributes:
        path: Absolute path of the file or folder.
        sha256: Checksum of its contents; None: there is no file.
        size_bytes: Size of its contents [bytes].
        recorded: When it was recorded (UTC).
    """

    path: str
    sha256: str | None
    size_bytes: int
    recorded: datetime


def log_file(path: str | Path, recorded: datetime | None = None) -> LogFile:
    """Return the reference to a file, or to a folder with all files below it.

    Args:
        path: The log.
        recorded: When it was recorded; None: when it was last modified.

    Raises:
        InputError: If it cannot be read.
    """
    path = Path(path)
    try:
        files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        sizes = [(file.stat().st_size, file.stat().st_mtime) for file in files]
        if recorded is None:
            latest = max((modified for _, modified in sizes), default=path.stat().st_mtime)
            recorded = datetime.fromtimestamp(latest, UTC)
        size = sum(count for count, _ in sizes)
        return LogFile(str(path.absolute()), _checksum(path, files), size, utc(recorded))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({reason(error)}). Expected a log that exists."
        ) from error


def _checksum(path: Path, files: list[Path]) -> str:
    """Return the SHA-256 of a file, or of the names and checksums of the files of a folder."""
    if files == [path]:
        return _sha256(path)
    lines = [f"{_sha256(file)}  {file.relative_to(path).as_posix()}\n" for file in files]
    return hashlib.sha256(os.fsencode("".join(lines))).hexdigest()


def _sha256(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def utc(time: datetime) -> datetime:
    """Return an instant in UTC; a time without a zone is UTC already."""
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)
