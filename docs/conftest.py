"""Run the code of the pages as tests."""

from __future__ import annotations

from sybil import Sybil

from executed import blocks, setup, teardown

pytest_collect_file = Sybil(
    parsers=[blocks],
    patterns=["benchmark.md", "store.md", "tutorials/*.md", "contributing/*.md", "reference/*.md"],
    setup=setup,
    teardown=teardown,
).pytest()
