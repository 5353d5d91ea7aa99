"""The wall: all robots as tiles, the worst first."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from nicegui import ui

from failuretwin.app.console import draw, texts
from failuretwin.app.console.layout import COLOURS, Visit, page
from failuretwin.app.console.state import Tile

PERIOD_S = 1.0
"""Time between two updates [s]."""
STYLE = """
.wall-filters { display: flex; flex-wrap: wrap; gap: .5rem 1rem; align-items: end;
  margin: .5rem 0; }
.wall-filters label { display: flex; flex-direction: column; font-size: .85rem; }
.wall-filters input, .wall-filters select { font-size: 1rem; border: 1px solid #6b757e;
  border-radius: .3rem; padding: .2rem .4rem; background: #fff; color: #16191c; min-height: 2rem; }
.wall { list-style: none; margin: 0; padding: 0; display: grid; gap: .5rem;
  grid-template-columns: repeat(auto-fill, minmax(min(17rem, 100%), 1fr)); }
.wall li { content-visibility: auto; contain-intrinsic-size: auto 7rem; }
.wall a { display: flex; flex-direction: column; gap: .15rem; height: 100%; padding: .5rem .7rem;
  border: 1px solid var(--line); border-left-width: .5rem; border-radius: .4rem; color: inherit;
  background: var(--soft); text-decoration: none; overflow-wrap: anywhere; }
.wall a .badges { display: flex; flex-wrap: wrap; gap: .3rem; }
.wall .said { font-size: .9rem; line-height: 1.4; display: -webkit-box; overflow: hidden;
  -webkit-box-orient: vertical; -webkit-line-clamp: 3; }
""" + "\n".join(f".wall .edge-{name} {{ border-left-color: {c}; }}" for name, c in COLOURS.items())


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
        ui.add_css(STYLE)
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
