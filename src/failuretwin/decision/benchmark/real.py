"""Recorded sets of others: public source, licence and the hash of every file.

Nothing is bundled. A file is known by its SHA-256, not by its place: what a repository calls its
folders does not matter.
"""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import tarfile
import urllib.request
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

from failuretwin.core.config import from_table
from failuretwin.core.errors import InputError, OutputError, reason
from failuretwin.core.foreign import files_below
from failuretwin.data_knowledge.store import replacing

ARCHIVE = "https://github.com/{repository}/archive/{commit}.tar.gz"
TIMEOUT_S = 60.0


@dataclass(frozen=True)
class RealSet:
    """One recorded set.

    Attributes:
        content: What was recorded.
        repository: Owner and name of the public repository.
        commit: Commit whose files are meant.
        folder: Folder there; empty: not stated.
        licence: Licence of the files.
        files: SHA-256 of each file, by its path in our layout.
    """

    content: str
    repository: str
    commit: str
    folder: str
    licence: str
    files: Mapping[str, str]

    def missing(self, folder: Path) -> list[str]:
        """Return the files that are not in a folder.

        Raises:
            InputError: If a file is not the published one.
        """
        missing = []
        for path, expected in self.files.items():
            there = folder / path
            if not there.is_file():
                missing.append(path)
            elif sha256(there.read_bytes()) != expected:
                raise InputError(
                    f"{there}: is not the published file. Expected SHA-256 {expected[:12]}. "
                    "Remove it and fetch it again."
                )
        return missing


def sha256(content: bytes) -> str:
    """Return the SHA-256 of a file's content."""
    return hashlib.sha256(content).hexdigest()


@cache
def real_sets() -> Mapping[str, RealSet]:
    """Return the recorded sets by name."""
    stored = json.loads((files(__package__) / "real_sets.json").read_text(encoding="utf-8"))
    return {name: from_table(RealSet, table, name) for name, table in stored.items()}


def folders_of(name: str, data: Path) -> list[Path]:
    """Return the folders of a recorded set, once all its files are there and unchanged.

    Other folders beside them do not belong to the set.

    Raises:
        InputError: If a file is missing or was changed.
    """
    folder, real = data / name, real_sets()[name]
    missing = real.missing(folder)
    if missing:
        raise InputError(
            f"{folder}: {len(missing)} of {len(real.files)} files are missing, such as "
            f"{missing[0]}. Fetch them: failuretwin data fetch {name} --data {data}, or from a "
            "copy of your own with --from FOLDER."
        )
    return sorted({(folder / path).parent for path in real.files})


def fetch(name: str, data: Path, source: Path | None) -> int:
    """Fill the folder of a recorded set and return the number of new files.

    Args:
        name: Name of the set.
        data: Folder of all data.
        source: Folder or .tar.gz with the files in any layout; None: the public repository.

    Raises:
        InputError: If the source does not hold all missing files.
    """
    real = real_sets()[name]
    wanted: dict[str, list[str]] = {}
    for path in real.missing(data / name):
        wanted.setdefault(real.files[path], []).append(path)
    count = sum(map(len, wanted.values()))
    for content in _contents(real, source) if wanted else ():
        for path in wanted.pop(sha256(content), ()):
            _write(content, data / name / path)
        if not wanted:
            break
    if wanted:
        left = sum(map(len, wanted.values()))
        raise InputError(
            f"{source or real.repository}: holds no published file for {left} of "
            f"{len(real.files)} paths of {name}, such as {next(iter(wanted.values()))[0]}. "
            "Expected unchanged copies."
        )
    return count


def _write(content: bytes, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        partial.write_bytes(content)


def _contents(real: RealSet, source: Path | None) -> Iterator[bytes]:
    if source is not None and source.is_dir():
        for path in files_below(source, "*"):
            yield path.read_bytes()
        return
    if source is not None and not source.is_file():
        raise InputError(f"{source}: does not exist. Expected a folder or a .tar.gz.")
    archive = _download(real) if source is None else source.read_bytes()
    try:
        with tarfile.open(fileobj=io.BytesIO(archive)) as opened:
            for member in opened:
                file = opened.extractfile(member) if member.isfile() else None
                if file is not None:
                    yield file.read()
    except (tarfile.TarError, EOFError, OSError, zlib.error) as error:
        raise InputError(
            f"{source or real.repository}: cannot be read as .tar.gz ({reason(error)}). Fetch it "
            "again, or unpack it and name the folder."
        ) from error


def _download(real: RealSet) -> bytes:
    address = ARCHIVE.format(repository=real.repository, commit=real.commit)
    buffer = io.BytesIO()
    try:
        with urllib.request.urlopen(address, timeout=TIMEOUT_S) as answer:
            shutil.copyfileobj(answer, buffer)
    except OSError as error:
        raise OutputError(
            f"{address}: cannot be fetched ({reason(error)}). Download it another way, then name "
            "the file or its folder with --from."
        ) from error
    return buffer.getvalue()
