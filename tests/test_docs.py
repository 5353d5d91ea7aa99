"""README and pages: names, files and links exist; snippets use public names; short sentences."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import failuretwin

ROOT = Path(__file__).parents[1]
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [*DOCS, ROOT / "README.md", ROOT / "CHANGELOG.md"]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
ENTRY_POINTS = {"failuretwin.modes"}
"""Groups of entry points: dotted names that are not modules."""
READER_FILES = {
    *("bent_shaft.py", "my_entry.py", "my_method.py", "my_so101.py"),
    *("arm.urdf", "cal.toml", "costs.toml", "faults.toml", "map.toml", "MAP.toml", "mine.toml"),
}
"""Files in examples that belong to the reader."""
FOREIGN_CLASSES = {"Dataset"}
"""Classes of xarray."""
INCLUDED = {"changelog.md", "looks.md"}
"""Pages that only include a file from elsewhere."""
FOLDERS = ("benchmarks", "docs", "examples", "src", "tests")

FENCE = re.compile(r"```([\w{}-]*)[^\n]*\n(.*?)```", re.DOTALL)
NAME = re.compile(r"`(failuretwin(?:\.\w+)+)")
PUBLIC = re.compile(r"\bft\.([A-Za-z]\w*)")
FILE = re.compile(r"`([\w./-]+\.(?:md|py|toml|urdf))`")
CLASS = re.compile(r"`(?:\w+\.)*?([A-Z][a-z]+\w*)(?:\.([a-z_]\w*))?\b[^`]*`")
LINK = re.compile(r"\]\(([^)\s]+)\)")


def page_name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def snippets(page: Path) -> list[str]:
    """Return the Python blocks of a page, or a script."""
    text = page.read_text("utf-8")
    if page.suffix == ".py":
        return [text]
    return [code for language, code in FENCE.findall(text) if language == "python"]


def resolve(dotted: str) -> Any:
    """Return the module, class, function or field of a dotted name, or raise."""
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found: Any = import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            fields = getattr(found, "__dataclass_fields__", {})
            found = fields[part] if part in fields else getattr(found, part)
        return found
    raise ModuleNotFoundError(dotted)


def deep_imports(source: str) -> Iterator[str]:
    """Yield imports other than `failuretwin` itself and its public names."""
    public = set(failuretwin.__all__)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.startswith("failuretwin."))
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            root, _, deeper = node.module.partition(".")
            names = [a.name for a in node.names if deeper or a.name not in public]
            if root == "failuretwin":
                yield from (f"{node.module}.{name}" for name in names)


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a page."""
    text = FENCE.sub("", page.read_text("utf-8"))
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.fixture(scope="module")
def classes() -> dict[str, set[str]]:
    """Return the fields, constants and methods of each class of the package."""
    found: dict[str, set[str]] = {}
    for path in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef):
                found.setdefault(node.name, set()).update(_parts(node))
    return found


def _parts(node: ast.ClassDef) -> Iterator[str]:
    for part in node.body:
        if isinstance(part, ast.FunctionDef):
            yield part.name
        elif isinstance(part, ast.AnnAssign | ast.Assign):
            targets = part.targets if isinstance(part, ast.Assign) else [part.target]
            yield from (target.id for target in targets if isinstance(target, ast.Name))


def glossary_rows() -> list[list[str]]:
    lines = (ROOT / "docs" / "glossary.md").read_text("utf-8").splitlines()
    rows = [line for line in lines if line.startswith("| ") and not line.startswith("| term")]
    return [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows]


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("from failuretwin.core.runs import RunTable", ["failuretwin.core.runs.RunTable"]),
        ("import failuretwin.app", ["failuretwin.app"]),
        ("from failuretwin import no_such_name", ["failuretwin.no_such_name"]),
        ("import failuretwin as ft\nfrom failuretwin import load_robot\nimport numpy", []),
    ],
)
def test_deep_imports_are_detected(source, found):
    assert list(deep_imports(source)) == found


@pytest.mark.parametrize("name", ["failuretwin.core.no_such_module", "failuretwin.core.runs.Nope"])
def test_missing_names_are_detected(name):
    with pytest.raises((AttributeError, ModuleNotFoundError)):
        resolve(name)


@pytest.mark.parametrize(
    "page", [p for p in (*PAGES, *EXAMPLES) if p.parent.name != "contributing"], ids=page_name
)
def test_snippets_import_only_public_names(page):
    assert [name for code in snippets(page) for name in deep_imports(code)] == []


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_names_on_the_page_exist(page):
    text = page.read_text("utf-8")
    for name in set(NAME.findall(text)) - ENTRY_POINTS:
        resolve(name)
    assert set(PUBLIC.findall(text)) <= set(failuretwin.__all__)


@pytest.mark.parametrize("page", [*DOCS, ROOT / "README.md"], ids=page_name)
def test_classes_on_the_page_exist(page, classes):
    text = FENCE.sub("", page.read_text("utf-8"))
    for name, part in CLASS.findall(text):
        assert name in {*classes, *FOREIGN_CLASSES}, name
        assert not part or part in classes[name], f"{name}.{part}"


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_files_on_the_page_exist(page):
    below = [path for name in FOLDERS for path in (ROOT / name).rglob("*")]
    files = [path.as_posix() for path in (*below, *ROOT.glob("*"))]
    for name in set(FILE.findall(page.read_text("utf-8"))) - READER_FILES:
        assert any(path.endswith(f"/{name}") for path in files), name


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_on_the_page_exist(page):
    for link in LINK.findall(FENCE.sub("", page.read_text("utf-8"))):
        path, _, anchor = link.partition("#")
        if "://" in path:
            continue
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", [p for p in DOCS if p.name not in INCLUDED], ids=page_name)
def test_a_page_opens_with_its_subject_and_code(page):
    title, text = page.read_text("utf-8").split("\n", 1)
    opening = text.partition("\n## ")[0]
    assert title.startswith("# ")
    assert FENCE.search(opening)
    assert sentences(FENCE.split(opening)[0])


def test_the_index_links_every_page():
    docs = ROOT / "docs"
    index = (docs / "index.md").read_text("utf-8")
    others = {page.relative_to(docs).as_posix() for page in DOCS} - {"index.md", *INCLUDED}
    assert others <= {link.partition("#")[0] for link in LINK.findall(index)}
    assert "docs/index.md" in LINK.findall((ROOT / "README.md").read_text("utf-8"))


def test_every_row_of_the_glossary_links_its_page():
    rows = glossary_rows()
    assert len(rows) > 30
    assert [row for row in rows if len(row) != 3 or not LINK.search(row[2])] == []
    terms = [row[0].lower() for row in rows]
    assert terms == sorted(terms)


def test_sections_named_by_docstrings_exist():
    found = set()
    for path in (ROOT / "src").rglob("*.py"):
        found |= set(re.findall(r"docs/(\w+\.md)(?:#([\w-]+))?", path.read_text("utf-8")))
    assert len(found) > 10
    for page, anchor in found:
        assert not anchor or anchor in anchors(ROOT / "docs" / page), (page, anchor)
        assert (ROOT / "docs" / page).exists()


def test_the_first_snippet_of_the_readme_prints_its_output(capsys):
    text = (ROOT / "README.md").read_text("utf-8")
    code, printed = re.search(r"```python\n(.*?)```\n\n```\n(.*?)```", text, re.DOTALL).groups()
    exec(compile(code, "README.md", "exec"), {})
    assert capsys.readouterr().out == printed


def code_of(pages: list[Path]) -> str:
    """Return all Python of the pages and scripts."""
    return "\n".join(code for page in pages for code in snippets(page))


@pytest.mark.parametrize("name", [n for n in failuretwin.__all__ if n != "__version__"])
def test_every_public_name_has_an_example(name):
    pages = [page for page in PAGES if page.name not in INCLUDED]
    assert re.search(rf"\bft\.{name}\b", code_of([*pages, *EXAMPLES]))


def test_the_reference_has_every_public_name_once():
    text = (ROOT / "docs" / "reference" / "api.md").read_text("utf-8")
    documented = re.findall(r"auto(?:class|function|exception):: failuretwin\.(\w+)", text)
    assert sorted(documented) == sorted(set(failuretwin.__all__) - {"__version__"})


def sentences(text: str) -> list[str]:
    """Return the sentences of a page, without code, equations, tables and addresses of links."""
    text = re.sub(r"^    .*$", "", FENCE.sub("\n\n", text), flags=re.MULTILINE)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    parts = re.split(r"\n\s*\n|\n(?=[-|#]|\d\. )", text)
    prose = [" ".join(part.split()) for part in parts if not part.startswith("|")]
    return [s for part in prose for s in re.split(r"(?<=[.!?:])\s+", part) if s]


@pytest.mark.parametrize(
    "page",
    [p for p in (*DOCS, ROOT / "README.md", ROOT / "CONTRIBUTING.md") if p.name not in INCLUDED],
    ids=page_name,
)
def test_sentences_are_short(page):
    text = page.read_text("utf-8")
    assert len(sentences(text)) > 2
    assert [s for s in sentences(text) if len(s.split()) >= 30] == []


def test_long_sentences_are_detected():
    assert max(len(s.split()) for s in sentences(f"Short. {'word ' * 40}end.\n")) == 41
