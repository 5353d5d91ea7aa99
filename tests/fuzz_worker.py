"""Runs cases of a fuzzer in a forked process that may take 2 GB, and says what came of each."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import traceback
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from bag_writers import write_bag
from failuretwin.core.errors import FailureTwinError
from fuzz_changes import bytes_changed, entries_changed, file_changed
from fuzz_seeds import SEEDS, bag_entries, trajectory_entries

LIMIT_BYTES = 2 * 10**9
SECONDS = 20
"""Longest processor time for a case [s]: more is taken to have no end."""
RECORDINGS = {
    "ros1": ("ros1", bag_entries),
    "ros2": ("ros2", bag_entries),
    "mcap": ("mcap", bag_entries),
    "trajectories": ("mcap", trajectory_entries),
}


@dataclass(frozen=True)
class Case:
    """A file to be made and read; the same seed makes the same file."""

    kind: str
    number: int
    seed: int

    @property
    def rng(self):
        return np.random.default_rng([self.seed, list(SEEDS).index(self.kind), self.number])


def cases(count: int, seed: int, kinds: list[str]) -> list[Case]:
    """Return so many cases, the kinds in turn."""
    return [Case(kinds[k % len(kinds)], k // len(kinds), seed) for k in range(count)]


def make_case(case: Case, sound: Path, folder: Path) -> Path:
    """Write the file of a case into an empty folder and return its path."""
    rng = case.rng
    if case.kind in RECORDINGS and rng.random() < 0.5:
        form, entries = RECORDINGS[case.kind]
        try:
            return write_bag(folder, form, entries_changed(entries(), rng))
        except Exception:  # no recorder could write this either
            pass
        for left in folder.iterdir():
            shutil.rmtree(left) if left.is_dir() else left.unlink()
    shutil.copytree(sound, folder, dirs_exist_ok=True)
    path = folder / (sound / "NAME").read_text()
    (folder / "NAME").unlink()
    # A profile is read with its URDF: either may be changed.
    file_changed(folder if case.kind == "profile" else path, rng)
    if path.is_file() and rng.random() < 0.05:
        path.write_bytes(bytes_changed(path.read_bytes(), rng))
    return path


def write_sound(folder: Path, kinds: list[str]) -> None:
    """Write a sound file of some kinds below a folder."""
    for kind in kinds:
        seed = SEEDS[kind]
        place = folder / kind
        place.mkdir()
        (place / "NAME").write_text(str(seed.make(place).relative_to(place)))


def run_cases(chosen: list[Case], sound: Path, scratch: Path) -> dict[Case, str]:
    """Return what came of each case: ``read``, ``refused: ...``, or what went wrong.

    A process that dies is told of the case that it died of, and the next goes on behind it.
    """
    found: dict[Case, str] = {}
    while len(found) < len(chosen):
        left = [case for case in chosen if case not in found]
        lines, status = _spawned(left, sound, scratch)
        for case, line in zip(left, lines, strict=False):
            found[case] = line
        if len(lines) < len(left):
            found[left[len(lines)]] = f"DIED: status {status}"
    return found


def _spawned(chosen: list[Case], sound: Path, scratch: Path) -> tuple[list[str], int]:
    """Return what came of the first cases, as many as there are, and how the process ended.

    A process of its own from the start: a fork has the locks of libraries, not their threads.
    """
    call = {
        "cases": [asdict(case) for case in chosen],
        "sound": str(sound),
        "scratch": str(scratch),
    }
    done = subprocess.run(
        [sys.executable, __file__],
        input=json.dumps(call),
        stdout=subprocess.PIPE,
        text=True,
        errors="replace",
        check=False,
    )
    lines = [json.loads(line) for line in done.stdout.splitlines(True) if line.endswith("\n")]
    return lines, done.returncode


def main() -> None:
    """Work on the cases that are told, and print a line for each."""
    call = json.loads(sys.stdin.read())
    out = os.dup(1)
    os.dup2(2, 1)  # what libraries print is no answer
    cases = [Case(**case) for case in call["cases"]]
    _work(cases, Path(call["sound"]), Path(call["scratch"]), out)


def _work(chosen: list[Case], sound: Path, scratch: Path, out: int) -> None:
    resource.setrlimit(resource.RLIMIT_DATA, (LIMIT_BYTES, LIMIT_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("ignore")
    late: list[str] = []
    sys.unraisablehook = lambda what: late.append(f"{what.exc_type.__name__}: {what.exc_value}")
    signal.signal(signal.SIGPROF, _too_long)
    for case in chosen:
        folder = scratch / f"{case.kind}_{case.number}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        late.clear()
        told = _outcome(case, sound, folder)
        if late:
            told = f"SECOND TRACEBACK: {late} after {told}"
        if _peak_bytes() > LIMIT_BYTES:
            told = f"MEMORY: more than {LIMIT_BYTES} bytes, {told}"
        if told == "read" or told.startswith("refused"):
            shutil.rmtree(folder, ignore_errors=True)
        os.write(out, (json.dumps(told) + "\n").encode())


def _peak_bytes() -> int:
    """Return the most memory that this program has had; `getrusage` counts who started it too."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (peak,) = [line for line in lines if line.startswith("VmHWM")]
    return 1024 * int(peak.split()[1])


def _too_long(*_):
    raise KeyboardInterrupt


def _outcome(case: Case, sound: Path, folder: Path) -> str:
    path = make_case(case, sound / case.kind, folder)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        SEEDS[case.kind].read(path)
    except FailureTwinError as error:
        said = str(error).replace(str(folder), "")
        if isinstance(error.__cause__, MemoryError):  # said in one line, but found out too late
            said += " [MemoryError]"
        return f"refused: {said}"
    except KeyboardInterrupt:
        return f"TOO LONG: {traceback.format_exc()}"
    except BaseException:
        return f"TRACEBACK: {traceback.format_exc()}"
    else:
        return "read"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


if __name__ == "__main__":
    main()
