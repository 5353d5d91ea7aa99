"""Work on many runs piece by piece, by one process or many; interrupted work is continued.

Whoever makes a piece writes it to a hidden folder, with a mark that holds its hash. The result
appears at the end, all at once.
"""

from __future__ import annotations

import glob
import hashlib
import json
import platform
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from failuretwin import __version__
from failuretwin.core.config import fingerprint
from failuretwin.core.errors import FailureTwinError, InputError, OutputError, reason
from failuretwin.core.progress import Progress
from failuretwin.data_knowledge.store import atomic_replace, sole_writer
from failuretwin.data_knowledge.workers import Workforce

DECISIVE = ("numpy", "scipy", "zarr", "numcodecs")
"""Packages, in addition to ourselves, whose versions may change bytes of a result."""


@dataclass(frozen=True)
class Unfinished(ABC):
    """Work in the making, with everything a worker needs to make a piece of it.

    Attributes:
        folder: The hidden folder, an absolute path.
        versions: Versions that a worker must have.
    """

    folder: Path
    versions: Mapping[str, str]

    @property
    @abstractmethod
    def sizes(self) -> Sequence[int]:
        """Number of runs (or logs) in each piece."""

    @abstractmethod
    def files(self, piece: int) -> list[Path]:
        """Return the files that a piece may have, in the order in which they are hashed."""

    @abstractmethod
    def make(self, piece: int) -> str:
        """Make a piece and write it, in any process; return its hash."""

    @property
    def unit(self) -> str:
        """What the pieces consist of."""
        return "runs"

    @abstractmethod
    def begin(self) -> None:
        """Write everything that does not depend on the runs, unless an earlier attempt has."""

    @abstractmethod
    def finish(self, content: str, path: Path) -> None:
        """Put the result in the place of `path`; on an OSError it is as before.

        Args:
            content: Hash of all pieces.
            path: Where the result belongs.
        """

    @property
    def marks(self) -> Path:
        """Folder of the marks, files named by the number of the piece."""
        return self.folder / "done"

    def digest(self, piece: int) -> str:
        """Return the hash of a piece: SHA-256 over name, NUL, size, NUL, bytes of its files."""
        total = hashlib.sha256()
        for file in self.files(piece):
            if file.is_file():  # one that was lost gives another hash
                data = file.read_bytes()
                total.update(f"{file.parent.name}/{file.name}\0{len(data)}\0".encode() + data)
        return total.hexdigest()

    def mark(self, piece: int) -> str:
        """Mark a piece as finished; return its hash."""
        digest = self.digest(piece)
        (self.marks / str(piece)).write_text(digest)
        return digest

    def finished(self) -> dict[int, str]:
        """Return the hash of every finished piece; a mark that does not fit is removed."""
        found = {}
        for mark in self.marks.iterdir():
            digest = self.digest(int(mark.name))
            if mark.read_text() == digest:
                found[int(mark.name)] = digest
            else:
                mark.unlink()
        return found

    def kept(self) -> int:
        """Return the number of runs in pieces that are marked as finished."""
        marks = self.marks.glob("*")
        return sum(self.sizes[int(mark.name)] for mark in marks if mark.stat().st_size)

    def carry_out(
        self,
        path: Path,
        workforce: Workforce,
        on_progress: Progress,
        tell: Callable[[str], None],
    ) -> None:
        """Make all missing pieces, and put the result in the place of `path`.

        Other unfinished work for `path` is removed. If this fails, finished pieces are kept.

        Args:
            path: The result; `folder` is its `hidden_folder`.
            workforce: Processes that do the work; the result does not depend on them.
            on_progress: Called with the number of further runs that are finished.
            tell: Called with one line about an earlier attempt, or about this one if it fails.

        Raises:
            InputError: If the workforce cannot be had or cannot do the work.
            OutputError: If the result cannot be written, or another process is writing it.
        """
        target = path.resolve()
        try:
            with sole_writer(target):
                self._remove_others(target)
                try:
                    self.begin()
                    self.finish(self._make_missing(workforce, on_progress, tell), target)
                except BaseException:
                    self._keep_finished(tell)
                    raise
        except OSError as error:
            if isinstance(error, FailureTwinError):
                raise
            raise OutputError(
                f"{path}: could not be written ({reason(error)}). Free some space or choose "
                "another place."
            ) from error

    def _remove_others(self, path: Path) -> None:
        for other in path.parent.glob(f".{glob.escape(path.name)}.{'[0-9a-f]' * 16}.partial"):
            if other != self.folder:
                shutil.rmtree(other)

    def _keep_finished(self, tell: Callable[[str], None]) -> None:
        """Say what is kept of unfinished work; remove it if that is nothing."""
        kept = self.kept()
        if not kept:
            self.remove()
            return
        tell(
            f"{kept} of {sum(self.sizes)} {self.unit} are kept in {self.folder}; the same command "
            "goes on from there"
        )

    def _make_missing(
        self,
        workforce: Workforce,
        on_progress: Progress,
        tell: Callable[[str], None],
    ) -> str:
        """Make every piece that is missing; return the hash of all."""
        digests, sizes = self.finished(), self.sizes
        kept = sum(sizes[piece] for piece in digests)
        if kept:
            tell(f"continuing: {kept} of {sum(sizes)} {self.unit} were there")
            on_progress(kept)
        missing = [piece for piece in range(len(sizes)) if piece not in digests]
        if missing:
            with workforce.map(self.make, missing) as made:
                for piece, digest in zip(missing, made, strict=True):
                    digests[piece] = digest
                    on_progress(sizes[piece])
        whole = "".join(digests[piece] for piece in range(len(sizes)))
        return hashlib.sha256(whole.encode()).hexdigest()

    def publish(self, result: Path, manifest: Mapping[str, Any], name: str, path: Path) -> None:
        """Put a folder with its manifest, a file of some name, in the place of `path`."""
        for torn in result.rglob("*.partial"):  # of a process that was killed as it wrote
            torn.unlink()
        text = json.dumps(manifest, indent=2, sort_keys=True) + "\n"
        (result / name).write_bytes(text.encode())
        atomic_replace(result, path)
        self.remove()

    def check_worker(self) -> None:
        """Raise InputError if this process has other versions, or cannot see the folder."""
        own = versions(*self.versions.keys() - {"failuretwin"})
        if own != self.versions:
            raise InputError(
                f"worker on {platform.node()} has {_listed(own)}, expected "
                f"{_listed(self.versions)}. Install the same versions there."
            )
        if not self.folder.is_dir():
            raise InputError(
                f"worker on {platform.node()} sees no {self.folder}. Write to a folder that "
                "all workers share under the same path."
            )

    def remove(self) -> None:
        """Remove all of it."""
        shutil.rmtree(self.folder, ignore_errors=True)


def hidden_folder(path: Path, manifest: Mapping[str, Any]) -> Path:
    """Return the folder of unfinished work for `path`, by all that decides what the result is."""
    target = path.resolve()  # a link stays a link
    return target.with_name(f".{target.name}.{fingerprint(manifest)[:16]}.partial")


def versions(*packages: str) -> dict[str, str]:
    """Return the versions that every process must share for bytes to be the same.

    Args:
        packages: The packages, in addition to ourselves; none: `DECISIVE`.
    """
    names = sorted(packages) or DECISIVE
    return {"failuretwin": __version__, **{n: import_module(n).__version__ for n in names}}


def _listed(found: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in found.items())
