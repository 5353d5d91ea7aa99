"""Errors meant for users: what was got, what was expected, how to fix it."""

from __future__ import annotations

from collections.abc import Iterable
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
