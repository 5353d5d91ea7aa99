"""Fault modes of a user: the one that the tutorial on fault modes offers for copying."""

from __future__ import annotations

import re
import sys
from contextlib import contextmanager
from pathlib import Path

from failuretwin.failure_behavior.registry import MODES, load_plugin

PAGE = Path(__file__).parents[1] / "docs" / "tutorials" / "own_fault_mode.md"


def code_on_the_page():
    return re.search(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)[1]


@contextmanager
def forgotten_afterwards():
    """Forget the modes, modules and folders that a plugin has added meanwhile."""
    before, modules, folders = dict(MODES), set(sys.modules), list(sys.path)
    try:
        yield
    finally:
        for name in MODES.keys() - before.keys():
            module = type(MODES._modes.pop(name)).__module__
            if module not in modules:
                sys.modules.pop(module, None)
        sys.path[:] = folders


@contextmanager
def registered_from(code, folder, name="mode_from_the_page"):
    """Give the mode that a module of this code registers."""
    path = folder / f"{name}.py"
    path.write_text(code)
    with forgotten_afterwards():
        before = set(MODES)
        load_plugin(str(path))
        (mode,) = MODES.keys() - before
        yield MODES[mode]
