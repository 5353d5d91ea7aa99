"""Tests that check nothing: results thrown away, and checks that are never called."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
ANSWERS = {"allclose", "array_equal", "array_equiv", "isclose", "isfinite", "isnan"}
"""Functions whose answer is lost unless it is used."""


def thrown_away(source: str) -> list[str]:
    """Return the statements that work out an answer and do nothing with it."""
    statements = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.Expr)]
    return [ast.unparse(s) for s in statements if _is_answer(s.value)]


def _is_answer(node: ast.expr) -> bool:
    if isinstance(node, ast.Call):
        return _last_name(node.func) in ANSWERS
    return isinstance(node, ast.Compare | ast.BoolOp | ast.UnaryOp)


def _last_name(node: ast.AST) -> str:
    return getattr(node, "attr", getattr(node, "id", ""))


def never_run(sources: dict[str, str]) -> list[str]:
    """Return the functions that check something but are neither collected nor called.

    Args:
        sources: Text of every test file by its name.
    """
    trees = {name: ast.parse(source) for name, source in sources.items()}
    used = {name for tree in trees.values() for name in _names_used(tree)}
    return [
        f"{file}: {function.name}"
        for file, tree in trees.items()
        for function in _functions(tree)
        if _checks(function) and not _collected(file, function) and function.name not in used
    ]


def _functions(tree: ast.AST) -> list[ast.FunctionDef]:
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


def _names_used(tree: ast.AST) -> set[str]:
    """Return names that are read, and arguments, since they may ask for a fixture."""
    nodes = list(ast.walk(tree))
    arguments = {node.arg for node in nodes if isinstance(node, ast.arg)}
    return arguments | {_last_name(n) for n in nodes if isinstance(n, ast.Name | ast.Attribute)}


def _checks(function: ast.FunctionDef) -> bool:
    nodes = list(ast.walk(function))
    calls = (_last_name(node.func) for node in nodes if isinstance(node, ast.Call))
    return any(isinstance(node, ast.Assert) for node in nodes) or any(
        name == "raises" or name.startswith("assert_") for name in calls
    )


def _collected(file: str, function: ast.FunctionDef) -> bool:
    return Path(file).name.startswith("test_") and function.name.startswith("test_")


@pytest.fixture(scope="module")
def sources():
    files = sorted(TESTS.rglob("*.py"))
    return {str(path.relative_to(TESTS)): path.read_text("utf-8") for path in files}


def test_no_answer_is_thrown_away(sources):
    assert {file: found for file, text in sources.items() if (found := thrown_away(text))} == {}


def test_every_check_is_run(sources):
    assert never_run(sources) == []


def test_no_two_files_have_one_name(sources):
    """Folders of tests are no packages: pytest imports two files of one name as one module."""
    names = [Path(name).name for name in sources if Path(name).name.startswith("test_")]
    assert [name for name, count in Counter(names).items() if count > 1] == []


@pytest.mark.parametrize(
    "statement",
    [
        "x == 1",
        "1 < x < 2",
        "not x == 1",
        "x == 1 and y == 2",
        "np.allclose(a, b)",
        "isclose(a, b)",
        "np.isclose(a, b)",
        "numpy.array_equal(a, b)",
    ],
)
def test_an_answer_thrown_away_is_seen(statement):
    assert thrown_away(f"def test_a():\n    {statement}\n") == [statement]


@pytest.mark.parametrize(
    "statement",
    ["assert x == 1", "y = x == 1", "assert np.allclose(a, b)", "check(x == 1)", "return x == 1"],
)
def test_an_answer_that_is_used_is_fine(statement):
    assert thrown_away(f"def test_a():\n    {statement}\n") == []


@pytest.mark.parametrize(
    "check", ["assert x", "np.testing.assert_allclose(x, 1)", "with pytest.raises(E): x()"]
)
def test_a_check_that_never_runs_is_seen(check):
    lost = f"def tets_a(x):\n    {check}\n"
    assert never_run({"test_a.py": lost}) == ["test_a.py: tets_a"]
    assert never_run({"helper.py": lost.replace("tets", "test")}) == ["helper.py: test_a"]


def test_a_check_that_runs_is_fine():
    collected = "def test_a(x):\n    assert x\n"
    called = "def check(x):\n    assert x\ndef test_b():\n    check(1)\n"
    fixture = "@pytest.fixture\ndef twin():\n    assert 1\n    return 2\n"
    asks = "def test_c(twin):\n    pass\n"
    assert never_run({"test_a.py": collected + called + asks, "conftest.py": fixture}) == []
