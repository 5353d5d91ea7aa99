"""Parts of all pages: texts, tables, choices, buttons."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from typing import TypeVar
from urllib.parse import quote, urlencode

from nicegui import events, run, ui

from failuretwin.app.console import texts
from failuretwin.core.errors import FailureTwinError
from failuretwin.core.foreign import printable

T = TypeVar("T")
EVENT_S = 0.05
"""Least time between two movements of a slider that are told [s]."""


def text(words: str, tag: str = "p") -> ui.label:
    """Draw text, never as markup; return its element."""
    return _Text(printable(words), tag)


def alert(words: str) -> ui.label:
    """Draw a text that screen readers say at once."""
    return text(words).props('role="alert"')


class _Text(ui.label):
    """A label with another tag."""

    def __init__(self, words: str, tag: str) -> None:
        super().__init__(words)
        self.tag = tag


def spoken(motor: str) -> str:
    """Return the name of a motor as verdicts say it."""
    return motor.replace("_", " ")


def heading(words: str, level: int = 2) -> ui.label:
    """Draw a heading."""
    return text(words, f"h{level}")


def badges(states: Sequence[str]) -> None:
    """Draw states by word, sign and colour."""
    with ui.element("p").classes("flex gap-2"):
        for state in states:
            words = f"{texts.SIGNS[state]} {texts.STATES[state]}"
            text(words, "span").classes(f"state state-{state}")


class Choice:
    """A choice that screen readers know: the select of the browser.

    Attributes:
        value: What is chosen.
    """

    def __init__(
        self,
        options: Sequence[str],
        value: str,
        label: str,
        on_change: Callable[[], object] = lambda: None,
        words: Callable[[str], str] = str,
    ) -> None:
        self.value = value
        self._options, self._on_change = options, on_change
        with ui.element("label").classes("flex flex-col text-sm"):
            text(label, "span")
            chosen = ui.element("select").classes("choice")
            chosen.on("change", self._choose, js_handler="(e) => emit(e.target.selectedIndex)")
            with chosen:
                for one in options:
                    option = text(words(one), "option")
                    if one == value:
                        option.props("selected")

    def _choose(self, event: events.GenericEventArguments) -> None:
        if isinstance(event.args, int) and 0 <= event.args < len(self._options):
            self.value = self._options[event.args]
            self._on_change()


class Slider(ui.element, component="slider.js"):
    """A slider: that of the browser, which arrow keys move.

    Attributes:
        value: Where it is.
    """

    def __init__(
        self,
        ends: tuple[float, float],
        step: float,
        value: float,
        label: str,
        on_change: Callable[[], object],
    ) -> None:
        super().__init__()
        self.value, self._on_change, self._ends = value, on_change, ends
        self._props |= {"low": ends[0], "high": ends[1], "step": step, "start": value}
        self._props["label"] = label
        self.classes("full-width")
        self.on("moved", self._moved, throttle=EVENT_S)

    def go_to(self, value: float) -> None:
        """Move it."""
        self._take(value)
        self.run_method("show", self.value)

    def _moved(self, event: events.GenericEventArguments) -> None:
        if isinstance(event.args, int | float):
            self._take(float(event.args))

    def _take(self, value: float) -> None:
        low, high = self._ends
        self.value = min(max(value, low), high)
        self._on_change()


Cell = str | Callable[[], object]
"""Cell of a table: text, or what draws it."""


def table(headings: Sequence[str], rows: Sequence[Sequence[Cell]]) -> None:
    """Draw a table; cells are texts, or draw themselves."""
    with ui.element("div").classes("scroll").props('tabindex="0" role="region"') as region:
        region.props(f'aria-label="{headings[0]}"')
        with ui.element("table").classes("plain"):
            with ui.element("thead"), ui.element("tr"):
                for one in headings:
                    text(one, "th").props('scope="col"')
            with ui.element("tbody"):
                for row in rows:
                    with ui.element("tr"):
                        for head, cell in zip(headings, row, strict=False):
                            place = text(cell if isinstance(cell, str) else "", "td")
                            place.props["data-label"] = head  # beside it on narrow pages
                            if not isinstance(cell, str):
                                with place:
                                    cell()


def link_to(page_name: str, **query: object) -> str:
    """Return the address of a page of a robot."""
    return f"/{page_name}?{urlencode(query, quote_via=quote, safe='')}"


async def worked(work: Callable[..., T], *values: object) -> T | None:
    """Do work in a thread; tell what is wrong and return None if it cannot be done."""
    try:
        return await run.io_bound(work, *values)
    except FailureTwinError as error:
        ui.notify(printable(str(error)), type="negative", multi_line=True, timeout=15_000)
        return None


def later(build: Callable[[], object]) -> None:
    """Draw a part that loads slowly once the page is shown."""
    ui.timer(0.0, build, once=True)


def button(words: str, press: Callable[[], object] | Callable[[], Awaitable[object]]) -> ui.button:
    """Draw a button."""
    return ui.button(words, on_click=press).props("no-caps dense").classes("px-3")
