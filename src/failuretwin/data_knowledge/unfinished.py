"""A Zarr run set in the making: a hidden folder beside its destination, fit to be continued.

It holds `manifest.json` (what is being made), `store` (the run set without the metadata of its
group, so that nothing can read it), `done` (a mark for every finished piece, with the hash of its
files) and `making` (files on their way into the store).
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import socket
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from failuretwin.core.fingerprint import fingerprint
from failuretwin.data_knowledge.swap import take_place
from failuretwin.data_knowledge.zarr_layout import Layout

MANIFEST = "manifest.json"
GROUP = "zarr.json"


@dataclass(frozen=True)
class Unfinished:
    """A run set in the making.

    Attributes:
        folder: The hidden folder.
        layout: What is written beside the runs.
    """

    folder: Path
    layout: Layout

    @property
    def store(self) -> Path:
        """What will be the run set."""
        return self.folder / "store"

    def add(self, piece: int, content: Mapping[str, bytes]) -> str:
        """Write a piece and mark it as done; return its hash.

        Every file appears whole, so it does no harm if two processes make the same piece.

        Raises:
            OSError: If a file cannot be written, or the folder is not there.
        """
        for name, data in content.items():
            self.put(self.store / name, data)
        digest = _digest(content)
        self.put(self._mark(piece), digest.encode())
        return digest

    def marked(self) -> list[int]:
        """Return the pieces that are marked as done, in their order."""
        return sorted(int(mark.name) for mark in (self.folder / "done").glob("*"))

    def finished(self) -> dict[int, str]:
        """Return the hash of every finished piece; a mark that does not fit is removed."""
        found = {}
        for piece in self.marked():
            files = {name: self.store / name for name in self.layout.piece_files(piece)}
            digest = _digest({n: f.read_bytes() for n, f in files.items() if f.is_file()})
            if self._mark(piece).read_text() == digest:
                found[piece] = digest
            else:
                self._mark(piece).unlink()
        return found

    def finish(self, manifest: Mapping[str, Any], path: Path) -> None:
        """Make the store readable and put it where `path` is.

        Raises:
            OSError: If that cannot be done; `path` is as before.
        """
        self.put(self.store / MANIFEST, _to_json(manifest))
        self.put(self.store / GROUP, self.layout.root)
        take_place(self.store, path)
        self.remove()

    def remove(self) -> None:
        """Remove all of it."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _mark(self, piece: int) -> Path:
        return self.folder / "done" / str(piece)

    def put(self, file: Path, data: bytes) -> None:
        """Write a file that appears whole or not at all.

        Raises:
            OSError: If it cannot be written.
        """
        maker = f"{socket.gethostname()}-{os.getpid()}-{threading.get_ident()}"
        new = self.folder / "making" / maker
        try:
            new.write_bytes(data)
            new.replace(file)
        except OSError:
            new.unlink(missing_ok=True)
            raise


def take_up(path: Path, layout: Layout, manifest: Mapping[str, Any]) -> Unfinished:
    """Return the run set in the making for `path`: what an earlier process left, or a new one.

    What is left of anything else that was to go to `path` is removed.

    Args:
        path: Where the run set will be, an absolute path.
        layout: Its layout.
        manifest: What is being made; work that says anything else is not continued.

    Raises:
        OSError: If a folder cannot be made.
    """
    name = f".{path.name}.{fingerprint(manifest)[:16]}.partial"
    pattern = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{16}}\.partial")
    for other in path.parent.iterdir():
        if pattern.fullmatch(other.name) and other.name != name:
            shutil.rmtree(other)
    unfinished = Unfinished(path.with_name(name), layout)
    if not _can_go_on(unfinished, manifest):
        _begin(unfinished, manifest)
    return unfinished


def _can_go_on(unfinished: Unfinished, manifest: Mapping[str, Any]) -> bool:
    if not _says(unfinished.folder, manifest):
        return False
    # A store that can be read has been finished; it may be an old one that has just been replaced.
    return not (unfinished.store / GROUP).exists() or _says(unfinished.store, manifest)


def _says(folder: Path, manifest: Mapping[str, Any]) -> bool:
    """Return whether the manifest in a folder says all that `manifest` says."""
    try:
        told = json.loads((folder / MANIFEST).read_bytes())
    except (OSError, ValueError):
        return False
    known = {key: told[key] for key in manifest if key in told}
    return fingerprint(known) == fingerprint(manifest)


def _begin(unfinished: Unfinished, manifest: Mapping[str, Any]) -> None:
    """Write all that does not depend on runs; the manifest comes last."""
    unfinished.remove()
    shared = {unfinished.store / name: data for name, data in unfinished.layout.shared.items()}
    try:
        for name in ("done", "making", "store"):
            (unfinished.folder / name).mkdir(parents=True)
        for file, data in shared.items():
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(data)
        unfinished.put(unfinished.folder / MANIFEST, _to_json(manifest))
    except OSError:
        unfinished.remove()
        raise


def whole_digest(pieces: Sequence[str]) -> str:
    """Return the hash of a run set: SHA-256 over the hashes of its pieces in their order."""
    return hashlib.sha256("".join(pieces).encode()).hexdigest()


def _digest(content: Mapping[str, bytes]) -> str:
    """Return the hash of a piece: SHA-256 over name, NUL, size, NUL, bytes of its files by name."""
    total = hashlib.sha256()
    for name in sorted(content):
        total.update(f"{name}\0{len(content[name])}\0".encode())
        total.update(content[name])
    return total.hexdigest()


def _to_json(value: Mapping[str, Any]) -> bytes:
    return (json.dumps(value, indent=2, sort_keys=True) + "\n").encode()
