"""Errors meant for users: what was got, what was expected, how to fix it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches


class FailureTwinError(Exception):
    """Base of every error that failuretwin raises on purpose."""


class InputError(FailureTwinError, ValueError):
    """Something that the user gave cannot be used; the text says how to fix it."""


class OutputError(FailureTwinError, OSError):
    """A result could not be written; nothing half-written is left behind."""


def unknown_name(kind: str, got: str, valid: Iterable[str]) -> InputError:
    """Return the error for a name that does not exist, with the nearest match.

    Args:
        kind: What the name stands for, such as ``"robot"``.
        got: The name as given.
        valid: Every name that exists.
    """
    names = list(valid)
    near = get_close_matches(got, names, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return InputError(f"unknown {kind} {got!r}.{hint} Valid: {', '.join(names)}.")


@contextmanager
def needs_extra(who: str, extra: str) -> Iterator[None]:
    """Import optional libraries in this block.

    Args:
        who: What needs them, and their names, such as ``"pictures need matplotlib"``.
        extra: The extra of this package that brings them.

    Raises:
        InputError: If one is missing; it says how to install it.
    """
    try:
        yield
    except ImportError as error:
        them = "them" if " and " in who else "it"
        raise InputError(
            f"{who} ({error}). Install {them}: pip install 'failuretwin[{extra}]'."
        ) from error


# Numbers that must lie within bounds: an error says which, what it is and what was expected.


def check_number(name: str, value: float, low: float = 0.0, high: float = 1e6) -> None:
    """Raise InputError unless `value` is a number from `low` to `high`."""
    if not low <= value <= high:
        raise InputError(f"{name} is {value:g}, expected a number from {low:g} to {high:g}.")


def check_share(name: str, value: float) -> None:
    """Raise InputError unless `value` is a share, from 0 to 1."""
    check_number(name, value, 0.0, 1.0)


def check_range(
    name: str, values: tuple[float, float], low: float = 0.0, high: float = 1e6
) -> None:
    """Raise InputError unless `values` are a lowest and a highest within bounds, in order."""
    if not low <= values[0] <= values[1] <= high:
        raise InputError(
            f"{name} is [{values[0]:g}, {values[1]:g}], expected the lowest and the highest value, "
            f"in order, from {low:g} to {high:g}."
        )
