"""Pages whose code is run: what they show works, and prints what stands below it.

    Save this as `FILE`:    the block that follows is written to FILE
    ```python               is run; all blocks of a page share one namespace
    ```sh                   is run, a `failuretwin` command in each line; one that ends with
                            `# refused` must be refused, and its error counts as printed
    ```text                 is what the block before it prints; `...` stands for anything

`python docs/executed.py PAGE...` runs pages and writes into them what their code prints now.
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
"""Where the warm command line is, for pages that are run outside of pytest."""
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
    """Return a process that runs commands without waiting for imports."""
    sys.path.append(str(TESTS))
    from warm_command import WarmCommand

    warm = WarmCommand()
    atexit.register(warm.close)
    return warm


def blocks(document: Document) -> Iterator[Region]:
    """Yield the blocks of a page that are run, written or compared."""
    for found in BLOCK.finditer(document.text):
        language, code = found["language"], found["code"]
        evaluate = write if found["file"] else EVALUATORS.get(language)
        if evaluate is not None:
            lexemes = {"file": found["file"], "at": found.start("code")}
            yield Region(found.start("language"), found.end(), code, evaluate, lexemes)


def write(example: Example) -> None:
    """Write a block to the file that the line before it names."""
    Path(example.region.lexemes["file"]).write_text(example.parsed, "utf-8")


def run_python(example: Example) -> None:
    """Run a block of Python and keep what it prints."""
    code = compile("\n" * example.line + example.parsed, example.path, "exec")
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(code, example.namespace)
    example.namespace[PRINTED] = TRAILING.sub("", out.getvalue())


def run_commands(example: Example) -> None:
    """Run `failuretwin` commands, one after the other, and keep what they print."""
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
    """Compare a block with what the block before it printed."""
    printed = example.namespace[PRINTED]
    checker, want = doctest.OutputChecker(), doctest.Example("", example.parsed)
    if not checker.check_output(want.want, printed, doctest.ELLIPSIS):
        raise AssertionError(checker.output_difference(want, printed, doctest.ELLIPSIS))


EVALUATORS = {"python": run_python, "sh": run_commands, "text": compare}


@contextlib.contextmanager
def in_a_folder_of_its_own() -> Iterator[None]:
    """Run what follows in an empty folder, and forget modules and modes that it brought."""
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
    """Enter the folder in which a page is run."""
    namespace["_folder"] = folder = contextlib.ExitStack()
    folder.enter_context(in_a_folder_of_its_own())


def teardown(namespace: dict[str, Any]) -> None:
    """Leave it."""
    namespace["_folder"].close()


def rewrite(page: Path) -> None:
    """Run a page and write into it what its code prints; blocks with `...` that fit stay."""
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
