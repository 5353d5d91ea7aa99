"""Lines on the terminal: text out of files, such as names of runs and topics, only as text."""

from __future__ import annotations

import click

from failuretwin.core.foreign import printable


def tell(text: str, *, err: bool = False) -> None:
    """Print a line to stdout, or to stderr."""
    click.echo(printable(text), err=err)
