"""What every diagnoser offers, and how one of the user's own is found by its name.

Section: docs/learned.md#a-method-of-your-own
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.runs import truth_of
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.explanation import worded

if TYPE_CHECKING:
    import xarray as xr


class Diagnoser(Protocol):
    """Whatever diagnoses runs: the Bayesian diagnoser, a network, both, or a class of the user.

    One method is all there is to write. A `Diagnosis` needs a run and a posterior; what else it
    holds, such as onset and size, is shown where it is there.
    """

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the diagnosis of each run.

        Args:
            runs: A run set; `command` (run, time, motor) [rad] and `measured` (run, time, axis)
                [m] alone may be looked at, never the truth.
        """
        ...


def diagnoser_from_text(text: str, twin: DigitalTwin) -> Diagnoser:
    """Return a diagnoser of the user's own, such as ``my_methods:Guess`` in ``my_methods.py``.

    Modules are looked for in the current folder and where Python finds its packages. Verdicts in
    words and the truth of the runs, for scores, are filled in where the class leaves them empty.

    Args:
        text: ``module:Class``; the class is called with the twin.
        twin: Digital twin of the robot whose runs are to be diagnosed.

    Raises:
        InputError: If there is no such module or class, or it has no method `diagnose`.
    """
    module_name, _, class_name = text.partition(":")
    module = _imported(module_name, text)
    if not hasattr(module, class_name):
        classes = [name for name, value in vars(module).items() if isinstance(value, type)]
        raise InputError(f"{text}: {unknown_name(f'class of {module_name}', class_name, classes)}")
    diagnoser = getattr(module, class_name)(twin)
    if not callable(getattr(diagnoser, "diagnose", None)):
        raise InputError(
            f"{text}: has no method `diagnose`. Expected a class with diagnose(runs) that returns "
            "a Diagnosis for each run."
        )
    return _Completed(diagnoser, text)


@dataclass(frozen=True)
class _Completed:
    """A diagnoser of the user's own, checked and with words and truth filled in."""

    diagnoser: Diagnoser
    name: str

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the diagnosis of each run.

        Raises:
            InputError: If that is not what the class returns.
        """
        found, faults = self.diagnoser.diagnose(runs), truth_of(runs)
        count = runs.sizes["run"]
        if len(found) != count or not all(isinstance(d, Diagnosis) for d in found):
            raise InputError(f"{self.name}: diagnose(runs) gave no Diagnosis for each of {count}.")
        truth: Sequence[str | None] = [None] * count if faults is None else faults
        made = [replace(d, truth=true) for d, true in zip(found, truth, strict=True)]
        return [d if d.verdict else worded(d, list(map(Hypothesis.parse, d.ranked))) for d in made]


def _imported(name: str, text: str) -> Any:
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        return import_module(name)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{text}: module {name!r} cannot be imported ({error}). Expected module:Class, with "
            "the module in the current folder or installed."
        ) from error
    finally:
        sys.path.remove(here)
