"""The state of a stream in a file: plain arrays, read without running anything."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.core.diagnosis import Diagnosis
from failuretwin.core.errors import InputError
from failuretwin.core.fingerprint import fingerprint
from failuretwin.data_knowledge.store import reason, replacing
from failuretwin.decision.bayes import BayesDiagnoser
from failuretwin.decision.streaming.fleet import StreamingFleet

FORMAT = 1
SUFFIX = ".npz"
HEADER = "header"


def save_fleet(fleet: StreamingFleet, path: str | Path, said: Sequence[Diagnosis] = ()) -> None:
    """Write the state of a stream; a file of that name is replaced at the end, all at once.

    Args:
        fleet: The stream.
        path: Where to.
        said: Diagnoses to be kept with it.

    Raises:
        InputError: If the suffix is not .npz.
        OutputError: If it cannot be written.
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise InputError(f"{path}: the file of a stream ends in {SUFFIX}.")
    header = {
        "format": FORMAT,
        "method": _method(fleet.diagnoser),
        "robots": fleet.robots,
        "movements": fleet.movements,
        "rate_hz": fleet.rate_hz,
        "said": [dataclasses.asdict(diagnosis) for diagnosis in said],
    }
    arrays: dict[str, Any] = {
        HEADER: np.frombuffer(json.dumps(header).encode(), dtype=np.uint8),
        **fleet.state(),
    }
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def load_fleet(
    path: str | Path, diagnoser: BayesDiagnoser, robots: int | None = None
) -> tuple[StreamingFleet, list[Diagnosis]]:
    """Return a stream as it was saved, and the diagnoses that were kept with it.

    Args:
        path: The file.
        diagnoser: The method with which it was saved.
        robots: How many robots there must be; None: any number.

    Raises:
        InputError: If it is no such file or of another robot, method or number of robots.
    """
    path = Path(path)
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        header = json.loads(arrays.pop(HEADER).tobytes())
        wrong = _mismatch(header, diagnoser, robots)
        if wrong:
            raise InputError(f"{path}: {wrong}")
        fleet = StreamingFleet(diagnoser, header["robots"], header["rate_hz"], header["movements"])
        fleet.restore(arrays)
        said = [Diagnosis.from_fields(fields) for fields in header["said"]]
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{path}: cannot be read as a stream ({reason(error)}). Expected a file that `save` of "
            "a stream wrote."
        ) from error
    return fleet, said


def _method(diagnoser: BayesDiagnoser) -> str:
    """Return a hash of all that answers depend on."""
    known = dataclasses.replace(diagnoser, imperfections=diagnoser.healthy_model.imperfections)
    return fingerprint(known)


def _mismatch(header: dict[str, Any], diagnoser: BayesDiagnoser, robots: int | None) -> str:
    """Return why a stream does not go on from a file, empty if it does."""
    if header["format"] != FORMAT:
        return f"is of format {header['format']}, this version reads {FORMAT}. Begin anew."
    if header["method"] != _method(diagnoser):
        return (
            "was saved with another robot, calibration, hypotheses or priors. Name the same, or "
            "begin anew."
        )
    if robots is not None and header["robots"] != robots:
        return f"is of {header['robots']} robots, expected {robots}."
    return ""
