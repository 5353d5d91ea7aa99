"""The wall: all robots as tiles, the worst first."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from nicegui import ui

from failuretwin.app.console import draw, texts
from failuretwin.app.console.layout import Visit, page
from failuretwin.app.console.state import Tile

PERIOD_S = 1.0
"""Time between two updates [s]."""


class Wall(ui.element, component="wall.js"):
    """Tiles; only those that changed are sent."""

    def __init__(self) -> None:
        super().__init__()
        self._props["words"] = texts.WALL_TEXTS
        self._shown: dict[str, dict[str, Any]] | None = None

    def show(self, tiles: dict[str, dict[str, Any]]) -> None:
        """Show these tiles."""
        shown = self._shown or {}
        changed = [one for name, one in tiles.items() if shown.get(name) != one]
        gone = [name for name in shown if name not in tiles]
        if changed or gone or self._shown is None:
            self._shown = tiles
            self.run_method("update", changed, gone)

    def forget(self) -> None:
        """Send all tiles next time: the browser shows none."""
        self._shown = None


def show(visit: Visit) -> None:
    """Draw the page."""
    with page(visit, texts.WALL):
        trouble = draw.alert("")
        note = draw.text("").props('role="status"')
        wall = Wall()
        ready = False

        def told(tile: Tile) -> Tile:
            return replace(tile, said=visit.words(tile.said, visit.desk.profile(tile.kind)))

        def update() -> None:
            if not ready:
                return
            trouble.set_text(visit.desk.trouble)
            note.set_text(visit.desk.note)
            wall.show({tile.name: told(tile).record() for tile in visit.desk.tiles()})

        def begin() -> None:
            nonlocal ready
            ready = True
            wall.forget()
            update()

        wall.on("ready", begin)
        ui.timer(PERIOD_S, update)
