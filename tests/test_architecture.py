from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import failuretwin

PACKAGE = Path(failuretwin.__file__).parent
ROOMS = (
    "core",
    "digital_model",
    "failure_behavior",
    "data_knowledge",
    "inference",
    "connection",
    "decision",
    "app",
)
"""From left to right; a room may import itself and those to its left."""

EXTRAS = {
    *(
        "alembic",
        "basyx",
        "dask",
        "distributed",
        "matplotlib",
        "mcap",
        "mujoco",
        "nats",
        "nicegui",
        "paho",
        "prometheus_client",
        "pyarrow",
        "rosbags",
        "roslibpy",
        "psycopg",
        "rospy",
        "sqlalchemy",
    ),
    *("sklearn", "torch"),
}


def imported_modules(module: str, source: str) -> list[str]:
    """Return every name that `source` imports, wherever it does so, or writes out as text."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = _absolute(module, node)
            names += [f"{base}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Constant) and re.fullmatch(r"failuretwin[.\w]+", str(node.value)):
            names.append(node.value)
    return names


def _absolute(module: str, node: ast.ImportFrom) -> str:
    if node.level == 0:
        return node.module or ""
    parents = module.split(".")[: -node.level]
    return ".".join([*parents, node.module] if node.module else parents)


def wrong_arrows(module: str, source: str) -> list[str]:
    """Return the imports of `module` that point to the right."""
    room = _room(module)
    if room is None:
        return []
    targets = {name: _room(name) for name in imported_modules(module, source)}
    return [
        f"{module} imports {name}"
        for name, target in targets.items()
        if target is not None and ROOMS.index(target) > ROOMS.index(room)
    ]


def _room(name: str) -> str | None:
    """Return the room that `name` belongs to; None for the root and for other packages."""
    root, _, rest = name.partition(".")
    part = rest.partition(".")[0]
    if root != "failuretwin" or part in ROOMS:
        return part if root == "failuretwin" else None
    home = getattr(getattr(failuretwin, part, None), "__module__", "failuretwin")
    return None if home == "failuretwin" else _room(home)


def source_files() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def module_name(path: Path) -> str:
    """Return the dotted name, with ``__init__`` kept so that relative imports count from it."""
    return ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)


def test_imports_point_left():
    found = [w for p in source_files() for w in wrong_arrows(module_name(p), p.read_text("utf-8"))]
    assert found == []


def test_all_code_is_in_a_room():
    homes = {path.relative_to(PACKAGE).parts[0] for path in source_files()}
    assert homes - {"__main__.py"} == {"__init__.py", *ROOMS}


def test_no_folder_has_more_than_twenty_files():
    folders = {path.parent for path in source_files()}
    crowded = {str(f): len(list(f.glob("*.py"))) - 1 for f in folders}
    assert {name: count for name, count in crowded.items() if count > 20} == {}


def circles(arrows: dict[str, set[str]]) -> list[str]:
    """Return the modules that import each other in a loop, found by removing leaves."""
    left = dict(arrows)
    while leaves := [name for name, to in left.items() if not to & left.keys()]:
        for name in leaves:
            del left[name]
    while roots := [name for name in left if not any(name in to for to in left.values())]:
        for name in roots:
            del left[name]
    return sorted(left)


def test_no_modules_import_each_other_in_a_circle():
    names = {module_name(path).removesuffix(".__init__") for path in source_files()}
    arrows = {}
    for path in source_files():
        module = module_name(path)
        found = set(imported_modules(module, path.read_text("utf-8")))
        found |= {name.rpartition(".")[0] for name in found}
        own = module.removesuffix(".__init__")
        arrows[own] = {name for name in found & names if name.count(".") > 1} - {own}
    assert circles(arrows) == []


def test_a_circle_is_caught():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set(), "e": {"a"}}) == ["b", "c"]


@pytest.mark.parametrize(
    "source",
    [
        "import failuretwin.inference.diagnoser",
        "import numpy, failuretwin.decision as d",
        "from failuretwin.inference.diagnoser import BayesDiagnoser",
        "from failuretwin import decision",
        "from failuretwin import DigitalTwin",
        "from ..decision import bayes",
        "from .. import decision",
        "def f():\n    from failuretwin.decision import bayes",
        "class A:\n    def f(self):\n        import failuretwin.app.cli",
        "if TYPE_CHECKING:\n    from failuretwin.digital_model.robot import Robot",
        "import_module('failuretwin.inference.diagnoser')",
        "try:\n    import os\nexcept ImportError:\n    import failuretwin.connection",
    ],
)
def test_an_arrow_to_the_right_is_caught(source):
    assert len(wrong_arrows("failuretwin.core.runs", source)) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("failuretwin.core.runs", "from failuretwin.core.errors import InputError"),
        ("failuretwin.core.runs", "from .errors import InputError"),
        ("failuretwin.core.runs", "from . import errors"),
        ("failuretwin.core.__init__", "from . import errors"),
        ("failuretwin.core.runs", "from failuretwin import __version__"),
        ("failuretwin.core.runs", "import numpy, xarray.decision"),
        ("failuretwin.inference.diagnoser", "from failuretwin import DigitalTwin"),
        ("failuretwin.inference.diagnoser", "from ..core import runs"),
        ("failuretwin.app.cli", "from failuretwin.inference.diagnoser import BayesDiagnoser"),
        ("failuretwin.__init__", "from failuretwin.inference.diagnoser import BayesDiagnoser"),
    ],
)
def test_other_arrows_are_allowed(module, source):
    assert wrong_arrows(module, source) == []


def run_python(code: str) -> list[str]:
    """Return the words that `code` prints in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, stdout=subprocess.PIPE, text=True, timeout=60
    )
    return done.stdout.split()


EVERYTHING_IN_CORE = """
import importlib, pkgutil, failuretwin, failuretwin.core
for module in pkgutil.iter_modules(failuretwin.core.__path__, "failuretwin.core."):
    importlib.import_module(module.name)
"""
PRINT_MODULES = "\nimport sys; print(*sys.modules)"


@pytest.mark.parametrize(
    "code",
    [
        "import failuretwin",
        EVERYTHING_IN_CORE,
        "from failuretwin import DigitalTwin, load_robot; DigitalTwin(load_robot('armpi_fpv'))",
        "import failuretwin, failuretwin.app.inputs",
    ],
    ids=["failuretwin", "core", "twin", "diagnose"],
)
def test_importing_loads_no_extras(code):
    loaded = set(run_python(code + PRINT_MODULES))
    assert "failuretwin" in loaded
    assert loaded & EXTRAS == set()


def test_an_extra_that_is_loaded_is_seen():
    pytest.importorskip("mujoco")
    assert "mujoco" in run_python("import mujoco" + PRINT_MODULES)


def test_importing_changes_nothing_in_the_process():
    code = f"""
import logging, os, random, signal, warnings
import numpy
def settings():
    return repr((
        dict(os.environ), os.getcwd(), numpy.geterr(), numpy.get_printoptions(), warnings.filters,
        logging.root.level, logging.root.handlers, signal.getsignal(signal.SIGINT),
        random.getstate(), numpy.random.get_state()[1].tolist(),
    ))
before = settings()
{EVERYTHING_IN_CORE}
from failuretwin import DigitalTwin, load_robot
print(settings() == before)
"""
    assert run_python(code) == ["True"]


HELP = """
import contextlib, io, sys
from failuretwin.app.cli import main
sys.argv = ["failuretwin", "--help"]
with contextlib.redirect_stdout(io.StringIO()) as told:
    main()
assert "Commands:" in told.getvalue()
"""


def packages(code: str) -> set[str]:
    """Return the packages that `code` loads, those of Python itself left out."""
    loaded = {name.partition(".")[0] for name in run_python(code + PRINT_MODULES)}
    return loaded - sys.stdlib_module_names


@pytest.mark.parametrize(
    ("code", "expected"),
    [("import failuretwin", {"failuretwin"}), (HELP, {"failuretwin", "click"})],
    ids=["failuretwin", "--help"],
)
def test_what_must_be_quick_loads_no_more_than_it_needs(code, expected):
    bare = packages("")  # what this interpreter loads when it starts
    assert packages(code) - bare == expected


def test_a_package_that_is_loaded_is_seen():
    assert "numpy" in packages("import numpy")
