"""What `benchmarks/unknown.py` prints."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def tell():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        return importlib.import_module("unknown").tell


def test_a_group_without_runs_has_no_row(tell, capsys):
    said = np.array(["unknown", "faulty"])
    tell("some", said, np.array([True, False]))
    tell("none", said, np.array([False, False]))
    printed = capsys.readouterr().out
    assert "some" in printed
    assert "1 of 1 (100.0%" in printed
    assert "none" not in printed
