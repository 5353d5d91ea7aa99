"""A stranger's files, whole and broken: read, or refused in the package's own words."""

from __future__ import annotations

from collections import Counter

import pytest

from fuzz_seeds import SEEDS
from fuzz_worker import cases, run_cases, write_sound

SEED = 20261122


QUICK = [kind for kind in SEEDS if kind != "network"]
"""Kinds that need no training first."""


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound")
    write_sound(folder, QUICK)
    return folder


def judge(chosen, sound, scratch):
    """Run cases; none may end otherwise than by being read or refused."""
    found = run_cases(chosen, sound, scratch)
    wrong = {c: t for c, t in found.items() if t != "read" and not t.startswith("refused: ")}
    told = "\n\n".join(f"{case}\n{text[-1500:]}" for case, text in list(wrong.items())[:5])
    assert not wrong, f"{len(wrong)} of {len(found)}\n{told}"
    return found


def test_sound_files_of_every_kind_are_read(sound):
    for kind in QUICK:
        SEEDS[kind].read(sound / kind / (sound / kind / "NAME").read_text())


def test_some_broken_files_of_every_kind(sound, tmp_path):
    judge(cases(45, SEED, QUICK), sound, tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_three_thousand_broken_files(sound, tmp_path):
    write_sound(sound, sorted(set(SEEDS) - set(QUICK)))
    found = judge(cases(3000, SEED + 1, list(SEEDS)), sound, tmp_path)
    count = Counter((case.kind, text == "read") for case, text in found.items())
    for kind in SEEDS:
        assert count[kind, False] >= 10, f"{kind}: the fuzzer hardly breaks it"
        assert count[kind, True] >= 3, f"{kind}: the fuzzer breaks it beyond all reading"
    assert not [text for text in found.values() if len(text.splitlines()) > 8]
