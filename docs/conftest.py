"""Run the code of the pages as tests."""

from __future__ import annotations

import pytest
from sybil import Sybil

from executed import blocks, setup, teardown

pytest_collect_file = Sybil(
    parsers=[blocks],
    patterns=["benchmark.md", "store.md", "tutorials/*.md", "contributing/*.md", "reference/*.md"],
    setup=setup,
    teardown=teardown,
).pytest()
LONGER = ("calibrate.md", "live.md")
"""Pages that learn from many runs, or watch for minutes."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave out the longer pages by default."""
    for item in items:
        if item.path.parent.name == "tutorials" and item.path.name in LONGER:
            item.add_marker(pytest.mark.slow)
