"""Errors for users: what was found, what was expected, how to fix it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches


class FailureTwinError(Exception):
    """Base of every error that failuretwin raises on purpose."""


class InputError(FailureTwinError, ValueError):
    """Unusable input; the text says how to fix it.

    Public functions list it under `Raises`; all others pass it on.
    """


class OutputError(FailureTwinError, OSError):
    """A result could not be written; no partial file is left."""


def unknown_name(kind: str, got: str, valid: Iterable[str]) -> InputError:
    """Return the error for an unknown name of a `kind` such as "robot", with the nearest match."""
    names = list(valid)
    near = get_close_matches(got, names, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return InputError(f"unknown {kind} {got!r}.{hint} Valid: {', '.join(names)}.")


def check_name(kind: str, got: str, valid: Iterable[str], where: str = "") -> None:
    """Raise the error of `unknown_name`, after the words `where`, unless a name is valid."""
    if got not in valid:
        raise InputError(f"{where}{unknown_name(kind, got, valid)}")


@contextmanager
def needs_extra(who: str, extra: str) -> Iterator[None]:
    """Import optional libraries in this block.

    Args:
        who: Feature and library, such as ``"pictures need matplotlib"``.
        extra: The extra of this package that installs the library.
    """
    try:
        yield
    except ImportError as error:
        them = "them" if " and " in who else "it"
        raise InputError(
            f"{who} ({error}). Install {them}: pip install 'failuretwin[{extra}]'."
        ) from error


def counted(count: int, noun: str) -> str:
    """Return a count with its noun: "1 run", "2 runs"."""
    return f"{count} {noun}{'s' * (count != 1)}"


def reason(error: BaseException) -> str:
    """Return the message of an error of the system or a library, on one line."""
    if isinstance(error, MemoryError):
        return "not enough memory"
    text = getattr(error, "strerror", None) or str(error)
    return one_line(str(text)) or type(error).__name__


def one_line(text: str) -> str:
    """Return an error text on one line, without details in parentheses."""
    return " ".join(text.partition("(")[0].split())
