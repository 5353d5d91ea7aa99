"""How far long work is: what does it calls a function with the number of steps just done."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int], None]
"""Called with the number of further steps."""


def unseen(steps: int) -> None:
    """Take no notice of progress."""
    del steps
