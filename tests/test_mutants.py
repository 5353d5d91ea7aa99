"""What `benchmarks/mutants.py` changes in a file, and what it leaves alone."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def find_mutants():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        return importlib.import_module("mutants").find_mutants


@pytest.mark.parametrize(
    ("formula", "changed"),
    [
        ("a + b", {"(a - b)", "a", "b"}),
        ("-a", {"a"}),
        ("a ** b", {"(a * b)", "a"}),
        ("2.0", {"3.0", "(-2.0)"}),
        ("x[1]", {"x[2]", "x[0]"}),
        ("a < b", {"(a >= b)"}),
        ("len(a) < b", {"(len(a) <= b)", "(len(a) >= b)"}),
        ("a and b", {"(a or b)", "a", "b"}),
        ("True", {"False"}),
        ("np.argmax(a)", {"(np.argmin(a))"}),
        ("x[a:b]", {"x[:b]", "x[a:]"}),
        ("np.where(c, a, b)", {"(np.where(c, b, a))"}),
        ("a if c else b", {"a", "b"}),
        ("np.sum(a, axis=1)", set()),
        ("np.maximum(a, 1e-12)", {"(np.minimum(a, 1e-12))"}),
        ("'text'", set()),
        ("f'{a + 1}'", set()),
    ],
)
def test_formulas_are_changed_one_place_at_a_time(find_mutants, formula, changed):
    source = f"y = {formula}\n".encode()
    found = [m.applied_to(source).decode() for place in find_mutants("a.py", source) for m in place]
    assert {text.removeprefix("y = ").removesuffix("\n") for text in found} == changed


def test_types_texts_and_errors_are_left_alone(find_mutants):
    source = b'''"""Some text."""
__all__ = ["f"]
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    X = 1 + 2


@dataclass(frozen=True)
class A:
    """More text."""

    def f(self, x: int | None) -> tuple[int, int]:
        """And more."""
        raise ValueError(f"{x} + 1" + "text")
'''
    assert find_mutants("a.py", source) == []


def test_a_mutant_says_where_it_is_and_what_it_changes(find_mutants):
    source = b"x = 1.0\nx[0] = 2.0\n"
    places = find_mutants("a.py", source)
    assert [place[0].line for place in places] == [1, 2, 2, 2]
    removed = next(m for place in places for m in place if m.kind == "statement left out")
    assert removed.diff(source) == "-x[0] = 2.0\n+pass"
