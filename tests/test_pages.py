"""The site: executed pages detect errors; generated files are up to date; the site builds."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from sybil import Document

import diagram
import executed
import notebooks

ROOT = Path(__file__).parents[1]


def run(page):
    """Run a page as its test does."""
    document = Document(page, "page.md")
    for region in executed.blocks(document):
        document.add(region)
    with executed.in_a_folder_of_its_own():
        for example in document.examples():
            example.evaluate()
    return document


def test_printed_output_is_compared():
    run("```python\nx = 2\nprint(x + 1)\n```\n\n```text\n3\n```\n")
    run("```python\nprint('a 0.123 b')\n```\n\n```text\na ... b\n```\n")


@pytest.mark.parametrize(
    "page",
    [
        "```python\nprint(1)\n```\n\n```text\n2\n```\n",
        "```python\nprint(1)\n```\n\n```text\n1\n2\n```\n",
        "```sh\nfailuretwin diagnose nowhere.csv\n```\n",
        "```sh\nfailuretwin --version   # refused\n```\n",
        "```sh\nls\n```\n",
    ],
)
def test_wrong_output_and_failed_commands_are_detected(page):
    with pytest.raises(AssertionError):
        run(page)


def test_files_are_written_and_refused_commands_expected():
    run(
        "Save this as `wrong.csv`:\n\n```csv\na,b\n1,2\n```\n\n"
        "```sh\nfailuretwin diagnose wrong.csv   # refused\n```\n\n"
        "```text\nerror: wrong.csv: ...\n```\n"
    )
    assert not Path("wrong.csv").exists()


def test_errors_have_the_line_number_of_the_page():
    with pytest.raises(ZeroDivisionError) as caught:
        run("# title\n\n```python\nx = 1\n1 / 0\n```\n")
    assert caught.traceback[-1].lineno + 1 == 5


def test_wrong_output_is_rewritten(tmp_path):
    page = tmp_path / "page.md"
    kept = "```python\nprint('a 1 b')\n```\n\n```text\na ...\n```\n"
    page.write_text(f"{kept}\n```python\nprint(3)\n```\n\n```text\n2\n```\n")
    executed.rewrite(page)
    assert page.read_text() == f"{kept}\n```python\nprint(3)\n```\n\n```text\n3\n```\n"


def test_the_picture_of_the_packages_is_up_to_date():
    found = diagram.imports()
    assert ("decision", "inference") in found
    assert ("inference", "decision") not in found
    assert diagram.PICTURE.read_text("utf-8") == diagram.picture(found), "python docs/diagram.py"


@pytest.mark.parametrize("name", notebooks.TUTORIALS)
def test_notebooks_match_their_tutorials(name):
    written = (notebooks.FOLDER / f"{name}.ipynb").read_text("utf-8")
    assert written == notebooks.text_of(name), "python docs/notebooks.py"


@pytest.mark.slow  # in Jupyter; each matches its tutorial, which is run as a page
@pytest.mark.parametrize("name", notebooks.TUTORIALS)
def test_a_notebook_runs(name, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:/usr/bin:/bin")
    monkeypatch.setenv("PYTHONWARNINGS", "default")
    notebook = nbformat.read(notebooks.FOLDER / f"{name}.ipynb", 4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those of Jupyter
        client = NotebookClient(notebook, timeout=120, resources={"metadata": {"path": tmp_path}})
        client.execute()
    printed = [out for cell in notebook.cells for out in cell.get("outputs", [])]
    assert any("sure" in out.get("text", "") for out in printed)


@pytest.mark.slow  # as `make docs` does, which builds it for every change
def test_the_site_builds_without_warnings(tmp_path):
    words = ["-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "docs", str(tmp_path)]
    done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    diagnosis = (tmp_path / "reference" / "api.html").read_text("utf-8")
    assert "cannot be read, or does not fit together" in diagnosis
    assert "--self-calibrate" in (tmp_path / "reference" / "cli.html").read_text("utf-8")
