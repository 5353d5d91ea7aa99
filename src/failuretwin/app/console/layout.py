"""What all pages share: header, colours, units, time zone, and who is at the page."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING
from zoneinfo import ZoneInfo

import numpy as np
from nicegui import ui

from failuretwin.app.console import draw, texts
from failuretwin.app.console.desk import Desk
from failuretwin.app.console.guard import ALIVE
from failuretwin.app.console.state import STAMP
from failuretwin.app.console.users import CONFIRM, Session
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    from starlette.requests import Request

EXPIRY_S = 5.0
"""Time between two looks whether the session has ended [s]."""
DIGITS = {"deg": 1, "rad": 3, "counts": 0}
"""Digits after the point, by unit; small differences have one more."""
NUMBER = re.compile(r"(\+- )?([+-]?\d+(?:\.\d+)?)")
DEGREES = re.compile(
    rf"(?P<place>stuck at )?(?P<values>{NUMBER.pattern}(?: (?:to )?{NUMBER.pattern})*) deg\b"
)
"""Angles in a text: where a motor stands, or differences or speeds, with deviations or ranges."""
STAMPS = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ")
"""Times (UTC) in a text."""
CHOICES = {"theme": texts.THEMES, "unit": texts.UNIT_NAMES}
YEAR_S = 31_536_000
STYLE, FOCUS = (Path(__file__).with_name(name) for name in ("console.css", "focus.js"))
"""Style of all pages, and the script that keeps the focus of a part that is drawn anew."""
ZONE_COOKIE = (
    "<script>{const zone='zone='+Intl.DateTimeFormat().resolvedOptions().timeZone;"
    "const known=()=>document.cookie.split('; ').includes(zone);if(!known()){"
    f"document.cookie=zone+';path=/;SameSite=Strict;max-age={YEAR_S}';if(known())location.reload()}}}}"
    "</script>"
)
"""Tells the server the time zone of the browser; a page that was made without it is made anew."""
RELOAD = (
    "<script>{let was=false,n=0;setInterval(async()=>{if(window.socket?.connected)was=true;"
    f"else if(++n%12===0&&(was||n>=120))try{{await fetch('{ALIVE}');location.reload()}}catch{{}}"
    "},250)}</script>"
)
"""Loads a page again that lost its server, or found none for 30 s, once that answers; without a
session it leads to the login."""


@dataclass(frozen=True)
class Visit:
    """A page that somebody has open.

    Attributes:
        desk: What the console knows.
        session: Who it is.
        theme: Colours, one of `texts.THEMES`.
        unit: Unit of angles, one of `texts.UNIT_NAMES`.
        zone: Time zone of the browser; None: that of this computer.
    """

    desk: Desk
    session: Session
    theme: str
    unit: str
    zone: ZoneInfo | None

    @classmethod
    def of(cls, desk: Desk, session: Session, request: Request) -> Visit:
        """Return the visit of a request; cookies that say something else count as missing."""
        cookies = request.cookies
        chosen = {
            name: cookies.get(name) if cookies.get(name) in choices else next(iter(choices))
            for name, choices in CHOICES.items()
        }
        return cls(desk, session, str(chosen["theme"]), str(chosen["unit"]), _zone(cookies))

    def allows(self, role: str) -> bool:
        """Return whether the person may do something, and tell if not."""
        if self.session.may(role):
            return True
        ui.notify(texts.NOT_ALLOWED.format(role=role), type="negative")
        return False

    @property
    def confirms(self) -> bool:
        """Whether the person may change the store."""
        return self.session.may(CONFIRM)

    def day(self, at: datetime) -> str:
        """Return the day of a time in the zone of the reader."""
        return f"{at.astimezone(self.zone):%Y-%m-%d}"

    def time(self, at: datetime | None, seconds: bool = False) -> str:
        """Return a time in the zone of the reader."""
        if at is None:
            return ""
        return f"{at.astimezone(self.zone):%Y-%m-%d %H:%M{':%S' if seconds else ''}}"

    def angle(self, value: float, robot: Robot, motor: int) -> str:
        """Return an angle of a motor [rad], or a place of one that slides [m], in words."""
        if robot.slides[motor]:
            return f"{1e3 * value:.1f} mm"
        told, unit = self._shown(value, robot)
        return f"{told:.{DIGITS[unit]}f} {unit}"

    def difference(self, value: float, robot: Robot, motor: int, directed: bool) -> str:
        """Return a difference of angles of a motor [rad], or of places [m], in words.

        One that is not directed, such as friction or a deviation, has the sign of the number.
        """
        if robot.slides[motor]:
            return f"{1e3 * value:.2f} mm"
        told, unit = self._shown(value, robot, relative=True)
        return f"{told if directed else np.copysign(told, value):z.{DIGITS[unit] + 1}f} {unit}"

    def held(self, told: float, robot: Robot, motor: int) -> float:
        """Return the angle [rad] or place [m] that a number in the unit of the reader means."""
        if robot.slides[motor]:
            return 1e-3 * told
        zero, one = (self._shown(value, robot)[0] for value in (0.0, 1.0))
        return (told - zero) / (one - zero)

    def unit_of(self, robot: Robot) -> str:
        """Return the unit in which angles of a robot are shown."""
        return self._shown(0.0, robot)[1]

    def words(self, text: str, robot: Robot | None) -> str:
        """Return a text with times in the zone of the reader, and angles [deg] in the unit.

        Angles of a robot whose profile is not known stay in degrees.
        """
        text = STAMPS.sub(lambda found: self._clock(found[0]), text)
        if robot is None or self.unit == "deg":
            return text

        unit = self.unit_of(robot)

        def number(relative: bool, found: re.Match[str]) -> str:
            value, _ = self._shown(float(np.deg2rad(float(found[2]))), robot, relative)
            size = relative and found[2][0] not in "+-"
            value = abs(value) if found[1] or size else value
            return f"{found[1] or ''}{value:.{DIGITS[unit]}f}"

        def told(found: re.Match[str]) -> str:
            place = found["place"] or ""
            return f"{place}{NUMBER.sub(partial(number, not place), found['values'])} {unit}"

        return DEGREES.sub(told, text)

    def _clock(self, stamp: str) -> str:
        """Return a time in the zone of the reader; of today only the time of day."""
        at = datetime.strptime(stamp, STAMP).replace(tzinfo=UTC)
        today = self.day(at) == self.day(datetime.now(UTC))
        return self.time(at, seconds=True).split()[-1] if today else self.time(at, seconds=True)

    def _shown(self, value: float, robot: Robot, relative: bool = False) -> tuple[float, str]:
        """Return an angle [rad] in the unit of the reader, and its name."""
        if self.unit == "counts" and robot.profile.servo_units is not None:
            counts = robot.servo_units.to_counts(np.array(value))
            zero = robot.servo_units.to_counts(np.array(0.0)) if relative else 0.0
            return float(counts - zero), "counts"
        return (value, "rad") if self.unit == "rad" else (float(np.rad2deg(value)), "deg")


def _zone(cookies: Mapping[str, str]) -> ZoneInfo | None:
    try:
        return ZoneInfo(cookies["zone"])
    except (KeyError, ValueError, OSError):
        return None


@contextmanager
def page(visit: Visit, title: str) -> Iterator[None]:
    """Draw what is around a page."""
    ui.page_title(f"{title} - {texts.TITLE}")
    ui.colors(primary="#1f5f99", negative="#b3261e", positive="#1b6e3c", warning="#8a5a00")
    ui.dark_mode({"auto": None, "light": False, "dark": True}[visit.theme])
    ui.add_css(STYLE)
    focus = f"<script>{FOCUS.read_text('utf-8')}</script>"
    ui.add_head_html(ZONE_COOKIE + focus + RELOAD)
    with ui.header().classes("items-center gap-4 py-2").props("elevated"):
        with ui.element("nav").classes("flex gap-4").props('aria-label="Main"'):
            for name, target in (
                (texts.WALL, "/"),
                (texts.CHECK, "/check"),
                (texts.IMPORT, "/import"),
            ):
                ui.link(name, target).classes("text-white")
        ui.space()
        _choice(visit.theme, "theme", texts.THEME)
        _choice(visit.unit, "unit", texts.UNITS)
        if visit.session.name:
            ui.label(texts.SIGNED_IN.format(name=visit.session.name, role=visit.session.role))
            with ui.element("form").props('method="post" action="/logout"'):
                ui.element("button").props('type="submit"').add_slot("default", texts.SIGN_OUT)
    main = ui.element("div").classes("page")
    ui.skip_link(texts.SKIP, target=main)

    def look() -> None:
        if not visit.session.valid:
            ui.navigate.to("/login")

    ui.timer(EXPIRY_S, look)
    with main:
        draw.heading(title, 1)
        yield


def _choice(value: str, name: str, label: str) -> None:
    """Draw a choice that the browser remembers in a cookie."""
    chosen = (
        f"document.cookie='{name}='+event.target.value+';path=/;SameSite=Strict;max-age={YEAR_S}'"
    )
    with ui.element("label").classes("text-white text-sm flex items-center gap-1"):
        draw.text(label, "span")
        with (
            ui.element("select")
            .props(f'name="{name}" onchange="{chosen};location.reload()"')
            .classes("text-black bg-white rounded px-1")
        ):
            for key, shown in CHOICES[name].items():
                option = draw.text(shown, "option").props(f'value="{key}"')
                if key == value:
                    option.props("selected")
