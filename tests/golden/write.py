"""Write the golden runs or what is expected of them; never done by a test.

    python tests/golden/write.py expected [CASE ...] [--force]
    python tests/golden/write.py runs [NAME ...] [--force]

Without names: all. What is there is only replaced with `--force`; look at what changed before you
keep it.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from golden_cases import CASES, outcome
from golden_runs import FOLDER, MADE, store

EXPECTED = Path(__file__).with_name("expected")


def expected_file(case):
    return EXPECTED / f"{case.replace(', ', '-').replace(' ', '_')}.json"


def expect(case):
    """Store what a case gives now, and return the file."""
    text = json.dumps(outcome(case), separators=(",", ":")) + "\n"
    path = expected_file(case)
    path.write_text(text, "utf-8")
    return path


KINDS = {
    "expected": (CASES, expected_file, expect),
    "runs": (MADE, lambda name: FOLDER / f"{name}.nc", store),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--force", action="store_true", help="replace what is there")
    options = parser.parse_args()
    known, file_of, write = KINDS[options.kind]
    names = options.names or list(known)
    strange = [name for name in names if name not in known]
    if strange:
        parser.error(f"no {options.kind} {', '.join(strange)}. Expected some of {', '.join(known)}")
    there = [str(file_of(name)) for name in names if file_of(name).exists()]
    if there and not options.force:
        parser.error(f"{', '.join(there)}: there already. Nothing written; --force replaces them")
    for folder in (EXPECTED, FOLDER):
        folder.mkdir(exist_ok=True)
    for name in names:
        path = write(name)
        print(f"wrote {path} ({path.stat().st_size / 1000:.0f} kB)")


if __name__ == "__main__":
    main()
