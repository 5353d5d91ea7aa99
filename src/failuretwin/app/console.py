"""Where tables go: the terminal, or a pipe wide enough to keep sentences whole."""

from __future__ import annotations

from rich.console import Console

PIPE_WIDTH = 160
"""Columns when the output is not a terminal."""


def console() -> Console:
    """Return the console to print on."""
    terminal = Console(highlight=False)
    return terminal if terminal.is_terminal else Console(highlight=False, width=PIPE_WIDTH)
