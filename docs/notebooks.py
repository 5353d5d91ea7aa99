"""Generate notebooks from tutorials: `python docs/notebooks.py`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import nbformat
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

HERE = Path(__file__).parent
FOLDER = HERE / "notebooks"
TUTORIALS = ("diagnose_a_log", "own_arm", "own_fault_mode", "own_classifier")
BLOCK = re.compile(r"^```(python|sh|text|xml|toml)\n(.*?)^```\n", re.MULTILINE | re.DOTALL)
SAVED = re.compile(r"Save (?:this|it) as `([\w.]+)`[^\n]*\n\n\Z")
LINK = re.compile(r"\]\((?!\w+://)([^)#]+)(#[^)]*)?\)")


def notebook_of(page: str) -> Any:
    """Return the notebook of a page: text, code and saved files, without printed output."""
    cells, at = [], 0
    for found in BLOCK.finditer(page):
        language, code = found.groups()
        text = page[at : found.start()]
        at = found.end()
        saved = SAVED.search(text)
        cells += _markdown(text)
        if saved:
            cells.append(new_code_cell(f"%%writefile {saved[1]}\n{code.rstrip()}"))
        elif language == "sh":
            cells.append(new_code_cell(_commands(code)))
        elif language == "python":
            cells.append(new_code_cell(code.rstrip()))
    cells += _markdown(page[at:])
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"  # else random
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return new_notebook(cells=cells, metadata={"kernelspec": kernel})


def _commands(code: str) -> str:
    lines = re.sub(r"\\\n\s*", "", code).splitlines()
    return "\n".join(f"!{line.partition(' #')[0].rstrip()}" for line in lines)


def _markdown(text: str) -> list[Any]:
    text = LINK.sub(lambda link: f"](../tutorials/{link[1]}{link[2] or ''})", text.strip())
    text = text.replace("(../tutorials/../", "(../")
    return [new_markdown_cell(text)] if text else []


def text_of(name: str) -> str:
    """Return the notebook file of a tutorial."""
    page = (HERE / "tutorials" / f"{name}.md").read_text("utf-8")
    return nbformat.writes(notebook_of(page)) + "\n"


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name in TUTORIALS:
        (FOLDER / f"{name}.ipynb").write_text(text_of(name), "utf-8")
        print(f"notebooks/{name}.ipynb: written")
