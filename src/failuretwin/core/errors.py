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


def counted(count: int, noun: str) -> str:
    """Return a number of things in words: "1 run", "2 runs"."""
    return f"{count} {noun}{'s' * (count != 1)}"


def reason(error: BaseException) -> str:
    """Return what the system or a library says of an error, on one line."""
    if isinstance(error, MemoryError):
        return "not enough memory"
    text = getattr(error, "strerror", None) or str(error)
    return one_line(str(text)) or type(error).__name__


def one_line(text: str) -> str:
    """Return the text of another library's error on one line, without its inner details."""
    return " ".join(text.partition("(")[0].split())
