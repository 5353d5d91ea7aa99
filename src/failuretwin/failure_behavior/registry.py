"""Registry of fault modes: built in, from installed packages, and registered."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path

from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import FailureTwinError, InputError, unknown_name
from failuretwin.core.hypothesis import Fault
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.failure_behavior.modes import BUILT_IN

ENTRY_POINTS = "failuretwin.modes"
"""Group of entry points; each names a module that registers modes."""


class ModeRegistry(Mapping[str, FaultMode]):
    """The fault modes by id, loaded at the first access."""

    def __init__(self) -> None:
        self._modes: dict[str, FaultMode] = {}
        self._filled = False

    def __getitem__(self, mode: str) -> FaultMode:
        return self._all()[mode]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())

    def add(self, mode: FaultMode) -> None:
        """Add a mode; see `register_mode`."""
        _check_complete(mode)
        known = self.get(mode.mode)
        if known in BUILT_IN or (known is not None and _origin(known) != _origin(mode)):
            raise InputError(
                f"there is a fault mode {mode.mode!r} already. Expected an id of its own; give "
                f"`mode` of {type(mode).__name__} another one."
            )
        self._modes[mode.mode] = mode

    def find(self, mode: str) -> FaultMode:
        """Return a mode by id; raise InputError if there is none."""
        if mode not in self:
            known = unknown_name("fault mode", mode, self)
            raise InputError(f"{known} If it is one of your own, name its module with --plugin.")
        return self[mode]

    def _all(self) -> dict[str, FaultMode]:
        if not self._filled:
            self._filled = True
            self._modes = {mode.mode: mode for mode in BUILT_IN}
            for entry in entry_points(group=ENTRY_POINTS):
                if not _is_being_imported(entry.value):  # else it registers its modes right now
                    _import_modes(entry.value, f"installed plugin {entry.name!r} ({entry.value})")
        return self._modes


MODES = ModeRegistry()
"""The modes with their default distributions; `stuck` and `steady_state_error` are the paper's."""


def plain_fault(fault: Fault) -> str:
    """Return a fault as a person would say it, ``motor 3 stuck``; by its id if it is not known."""
    motor, mode = fault.motor.replace("_", " "), MODES.get(fault.mode)
    return f"{motor} {fault.mode.replace('_', ' ')}" if mode is None else mode.plain_name(motor)


def register_mode(mode: FaultMode) -> None:
    """Make a mode of your own available to simulation, diagnosis and the command line.

    Args:
        mode: The mode with its default distributions.

    Raises:
        InputError: If it is not a mode, is incomplete, or its id is taken.
    """
    MODES.add(mode)


def _origin(mode: FaultMode) -> tuple[str, str]:
    """Return module and class of a mode: a module that is run again replaces its modes."""
    return type(mode).__module__, type(mode).__qualname__


def _check_complete(mode: FaultMode) -> None:
    """Raise InputError unless `mode` is an instance of a fault mode with all required fields."""
    if not isinstance(mode, FaultMode):
        raise InputError(
            f"{mode!r} is no fault mode. Expected an object of a class derived from FaultMode, "
            "such as register_mode(BentShaft())."
        )
    if mode.mode in ("healthy", "unknown"):
        raise InputError(
            f"{type(mode).__name__}.mode is {mode.mode!r}, which stands for no fault mode. Give it "
            "an id of its own."
        )
    for field, example in (("mode", "bent_shaft"), ("unit", "rad")):
        value = getattr(mode, field, None)
        if not (isinstance(value, str) and value) or (field == "mode" and not value.isidentifier()):
            raise InputError(
                f"{type(mode).__name__}.{field} is {value!r}, expected text. Add it to the class, "
                f'such as: {field} = "{example}".'
            )


def load_plugin(source: str) -> None:
    """Import a module that registers modes of your own.

    Args:
        source: Its name, importable from the current folder too, or the path of a ``.py`` file.

    Raises:
        InputError: If it cannot be imported, or registers no mode.
    """
    path, what = Path(source).resolve(), f"plugin {source!r}"
    is_file = path.suffix == ".py"
    if is_file and not path.is_file():
        raise InputError(f"{what}: there is no such file. Expected a Python file; check the path.")
    folder = str(path.parent if is_file else Path.cwd())
    if folder not in sys.path:
        sys.path.append(folder)  # last, so that it hides nothing; worker processes have it too
    found = _import_modes(path.stem if is_file else source, what)
    if is_file and found is not None and found != path:
        raise InputError(
            f"{what}: the name {path.stem!r} belongs to {found} already. Expected a name that no "
            "other module has; rename the file."
        )


def _is_being_imported(name: str) -> bool:
    spec = getattr(sys.modules.get(name), "__spec__", None)
    return bool(getattr(spec, "_initializing", False))


def _import_modes(name: str, what: str) -> Path | None:
    """Import the module `name` that registers modes and return its file.

    Errors call it `what`.
    """
    before = set(MODES)
    try:
        module = import_module(name)
    except FailureTwinError as error:
        raise InputError(f"{what}: {error}") from error
    except Exception as error:
        raise InputError(
            f"{what}: cannot be imported ({type(error).__name__}: {error}). Expected a module that "
            "Python finds in the current folder or among what is installed, or the path of a .py "
            "file; check the name, then the module."
        ) from error
    if set(MODES) == before and not any(type(m).__module__ == name for m in MODES.values()):
        raise InputError(
            f"{what}: it registers no fault mode. Expected a call of "
            "failuretwin.register_mode(YourMode()) in it; add one."
        )
    return None if module.__file__ is None else Path(module.__file__).resolve()


def plugin_files() -> list[Path]:
    """Return the files of modes that are not built in, for workers to import."""
    names = {type(mode).__module__ for mode in MODES.values()}
    files = [getattr(sys.modules.get(name), "__file__", None) for name in sorted(names)]
    own = Path(__file__).parents[1]
    paths = [Path(file) for file in files if file is not None]
    return [path for path in paths if own not in path.parents]


# Other distributions of the modes.


def load_modes(path: Path) -> Mapping[str, FaultMode]:
    """Return all modes by id, with distributions from a TOML file with one table per mode.

    Args:
        path: The file. Missing modes stay as in `MODES`; missing keys have the defaults of their
        mode.

    Raises:
        InputError: If the file cannot be read, names an unknown mode or key, or has an invalid
        value.
    """
    modes = dict(MODES)
    for name, table in read_toml(path).items():
        try:
            mode = MODES.find(name)
            if not isinstance(table, dict):
                raise InputError(f"{name} is {table!r}, expected a table, such as [{name}].")
            modes[name] = from_table(type(mode), table, name)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    return modes
