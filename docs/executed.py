"""Run the code blocks of a page and compare the printed output.

    Save this as `FILE`:    writes the next block to FILE
    ```python               runs; all blocks of a page share one namespace
    ```sh                   runs one `failuretwin` command per line; a line that ends with
                            `# refused` must fail, and its error counts as output
    ```text                 expected output of the previous block; `...` matches anything

`python docs/executed.py PAGE...` runs pages and updates their expected output.
"""

from __future__ import annotations

import atexit
import contextlib
import doctest
import io
import os
import re
import shlex
import sys
import tempfile
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sybil import Document, Example, Region

TESTS = Path(__file__).parents[1] / "tests"
"""Folder of the warm command line, for runs outside of pytest."""
if TYPE_CHECKING:
    from warm_command import WarmCommand

BLOCK = re.compile(
    r"(?:^[^\n]*Save (?:this|it) as `(?P<file>[\w.]+)`[^\n]*\n\n)?"
    r"^```(?P<language>[a-z]+)\n(?P<code>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
TRAILING = re.compile(r"[ \t]+$", re.MULTILINE)
PRINTED = "_printed_by_the_block_before"


@cache
def command_line() -> WarmCommand:
    """Return a process that runs commands with all imports done."""
    sys.path.append(str(TESTS))
    from warm_command import WarmCommand

    warm = WarmCommand()
    atexit.register(warm.close)
    return warm


def blocks(document: Document) -> Iterator[Region]:
    """Yield the blocks of a page to run, write or compare."""
    for found in BLOCK.finditer(document.text):
        language, code = found["language"], found["code"]
        evaluate = write if found["file"] else EVALUATORS.get(language)
        if evaluate is not None:
            lexemes = {"file": found["file"], "at": found.start("code")}
            yield Region(found.start("language"), found.end(), code, evaluate, lexemes)


def write(example: Example) -> None:
    """Write a block to the file named in the line before it."""
    Path(example.region.lexemes["file"]).write_text(example.parsed, "utf-8")


def run_python(example: Example) -> None:
    """Run a block of Python and keep its output."""
    code = compile("\n" * example.line + example.parsed, example.path, "exec")
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(code, example.namespace)
    example.namespace[PRINTED] = TRAILING.sub("", out.getvalue())


def run_commands(example: Example) -> None:
    """Run `failuretwin` commands one after the other and keep their output."""
    printed = ""
    for line in re.sub(r"\\\n\s*", "", example.parsed).splitlines():
        words = shlex.split(line, comments=True)
        if not words:
            continue
        assert words[0] == "failuretwin", f"{words[0]}: only failuretwin is run here"
        done = command_line().run(*words[1:], folder=Path.cwd())
        refused = line.endswith("# refused")
        assert done.returncode == (2 if refused else 0), f"{line}\n{done.stdout}{done.stderr}"
        printed += done.stdout + (done.stderr if refused else "")
    example.namespace[PRINTED] = TRAILING.sub("", printed)


def compare(example: Example) -> None:
    """Compare a block with the output of the previous block."""
    printed = example.namespace[PRINTED]
    checker, want = doctest.OutputChecker(), doctest.Example("", example.parsed)
    if not checker.check_output(want.want, printed, doctest.ELLIPSIS):
        raise AssertionError(checker.output_difference(want, printed, doctest.ELLIPSIS))


EVALUATORS = {"python": run_python, "sh": run_commands, "text": compare}


@contextlib.contextmanager
def in_a_folder_of_its_own() -> Iterator[None]:
    """Work in an empty temporary folder; restore fault modes and modules afterwards."""
    from failuretwin.failure_behavior.registry import MODES

    home, modes, paths, modules = Path.cwd(), dict(MODES), list(sys.path), set(sys.modules)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        sys.path.insert(0, folder)
        try:
            yield
        finally:
            os.chdir(home)
            sys.path[:] = paths
            for name in MODES.keys() - modes.keys():
                MODES._modes.pop(name)
            for name in sys.modules.keys() - modules:
                if str(getattr(sys.modules[name], "__file__", "")).startswith(folder):
                    del sys.modules[name]


def setup(namespace: dict[str, Any]) -> None:
    """Enter the temporary folder of a page."""
    namespace["_folder"] = folder = contextlib.ExitStack()
    folder.enter_context(in_a_folder_of_its_own())


def teardown(namespace: dict[str, Any]) -> None:
    """Leave the temporary folder."""
    namespace["_folder"].close()


def rewrite(page: Path) -> None:
    """Run a page and update its expected output; matching blocks with `...` stay."""
    text = page.read_text("utf-8")
    document = Document(text, str(page))
    for region in blocks(document):
        document.add(region)
    changes = []
    with in_a_folder_of_its_own():
        for example in document.examples():
            try:
                example.evaluate()
            except AssertionError:
                if example.region.evaluator is not compare:
                    raise
                at = example.region.lexemes["at"]
                changes.append((at, at + len(example.parsed), document.namespace[PRINTED]))
    for start, end, printed in reversed(changes):
        text = text[:start] + printed + text[end:]
    page.write_text(text, "utf-8")


if __name__ == "__main__":
    warnings.simplefilter("error")
    for name in sys.argv[1:]:
        rewrite(Path(name).resolve())
        print(f"{name}: run")
