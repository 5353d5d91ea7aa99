"""The state of a stream in a file: plain arrays, read without running anything."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.fingerprint import fingerprint
from failuretwin.data_knowledge.store import reason, replacing
from failuretwin.decision.bayes import BayesDiagnoser
from failuretwin.decision.streaming.fleet import StreamingFleet

FORMAT = 1
SUFFIX = ".npz"
HEADER = "header"


def save_fleet(fleet: StreamingFleet, path: Path) -> None:
    """Write the state of a stream; a file of that name is replaced at the end, all at once.

    Raises:
        InputError: If the suffix is not .npz.
        OutputError: If it cannot be written.
    """
    if path.suffix != SUFFIX:
        raise InputError(f"{path}: the file of a stream ends in {SUFFIX}.")
    header = {
        "format": FORMAT,
        "method": _method(fleet.diagnoser),
        "robots": fleet.robots,
        "movements": fleet.movements,
        "rate_hz": fleet.rate_hz,
    }
    arrays: dict[str, Any] = {
        HEADER: np.frombuffer(json.dumps(header).encode(), dtype=np.uint8),
        **fleet.state(),
    }
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def load_fleet(path: Path, diagnoser: BayesDiagnoser, robots: int | None = None) -> StreamingFleet:
    """Return a stream as it was saved.

    Args:
        path: The file.
        diagnoser: The method with which it was saved.
        robots: How many robots there must be; None: any number.

    Raises:
        InputError: If it is no such file or of another robot, method or number of robots.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        header = json.loads(arrays.pop(HEADER).tobytes())
        _check(header, diagnoser, robots, path)
        fleet = StreamingFleet(diagnoser, header["robots"], header["rate_hz"], header["movements"])
        fleet.restore(arrays)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{path}: cannot be read as a stream ({reason(error)}). Expected a file that `save` of "
            "a stream wrote."
        ) from error
    return fleet


def _method(diagnoser: BayesDiagnoser) -> str:
    """Return a hash of all that answers depend on."""
    known = dataclasses.replace(diagnoser, imperfections=diagnoser.healthy_model.imperfections)
    return fingerprint(known)


def _check(
    header: dict[str, Any], diagnoser: BayesDiagnoser, robots: int | None, path: Path
) -> None:
    if header["format"] != FORMAT:
        raise InputError(
            f"{path}: is of format {header['format']}, this version reads {FORMAT}. Begin anew."
        )
    if header["method"] != _method(diagnoser):
        raise InputError(
            f"{path}: was saved with another robot, calibration, hypotheses or priors. Name the "
            "same, or begin anew."
        )
    if robots is not None and header["robots"] != robots:
        raise InputError(f"{path}: is of {header['robots']} robots, expected {robots}.")
