"""What a robot went through, and what people say of it: into the store, undoable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from nicegui import ui

from failuretwin.app.console import draw, texts
from failuretwin.app.console.layout import Visit, page
from failuretwin.app.console.users import CONFIRM
from failuretwin.connection.fault_rates import LearnedRates
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.data_knowledge.records.episodes import CONFIRMED
from failuretwin.data_knowledge.records.history import (
    OTHER_CAUSE,
    WRONG,
    FaultEpisode,
    History,
)
from failuretwin.data_knowledge.records.offsets import Drift
from failuretwin.data_knowledge.records.store import Store
from failuretwin.inference.explanation import plain_name

DIRECTED = ("zero", "bias")
"""Offsets that turn a motor one way or the other; others are sizes."""
LONGEST = 200
"""Length of a name, note, cause or part [letters]."""


async def show(visit: Visit, name: str) -> None:
    """Draw the page."""
    desk = visit.desk
    with page(visit, f"{texts.HISTORY}: {name}"):
        ui.link(name, draw.link_to("robot", name=name))
        if desk.store is None or name not in desk.store.robots():
            draw.alert(texts.NO_STORE if desk.store is None else texts.NO_ROBOT)
            return
        HistoryPage(visit, name, desk.store)


class HistoryPage:
    """The history of one robot; what a person states is stored and drawn anew."""

    def __init__(self, visit: Visit, name: str, store: Store) -> None:
        self._visit, self._name, self._store = visit, name, store
        self._repaired = ""
        signed = visit.session.name
        with ui.row().classes("gap-4 items-end") as fields:
            self._person = _field(texts.YOUR_NAME, signed)
            if signed:
                self._person.props("readonly")
            self._note, self._cause = _field(texts.NOTE), _field(texts.CAUSE)
        fields.set_visibility(visit.confirms)
        self._body = ui.element("div")
        self._draw()

    def _draw(self) -> None:
        history = self._store.history(self._name)
        self._body.clear()
        with self._body:
            draw.text(history.health_by(self._visit.day))
            self._episodes(history)
            self._repair(history)
            self._rates(history.kind)
            _timeline(self._visit, history)
            _compare(self._visit, history)

    async def _state(self, work: Callable[[], object]) -> None:
        """Store what a person states, and draw the history anew."""
        if not self._visit.allows(CONFIRM):
            return

        told = {field: field.value for field in (self._note, self._cause)}

        def stored() -> bool:
            work()
            self._visit.desk.look()
            return True

        if await draw.worked(stored):
            ui.notify(texts.STORED, type="positive")
            for field, value in told.items():
                if field.value == value:  # otherwise the next words are being written
                    field.set_value("")
            self._draw()

    def _found(self, episode: FaultEpisode, verdict: str) -> None:
        self._store.found(
            self._name,
            episode.number,
            verdict,
            cause=_value(self._cause),
            person=_filled(self._person, texts.YOUR_NAME),
            note=_value(self._note),
        )

    def _withdraw(self, episode: FaultEpisode) -> None:
        person, note = _filled(self._person, texts.YOUR_NAME), _value(self._note)
        self._store.withdraw(self._name, episode.number, person=person, note=note)

    def _episodes(self, history: History) -> None:
        draw.heading(texts.EPISODES)
        time = self._visit.time
        rows: list[list[draw.Cell]] = []
        for one in reversed(history.episodes):
            found = one.finding
            said = (
                ""
                if found is None
                else ", ".join(
                    part for part in (found.verdict, found.cause, found.note, found.person) if part
                )
            )
            until = f" - {time(one.until)}" if one.until else ""
            rows.append([
                str(one.number),
                one.fault,
                one.state,
                f"{time(one.since)}{until}",
                said,
                self._buttons(one),
            ])  # fmt: skip
        heads = (texts.EPISODE, texts.FAULT, texts.STATE, texts.SINCE, texts.FINDING, "")
        draw.table(heads if self._visit.confirms else heads[:-1], rows)

    def _buttons(self, episode: FaultEpisode) -> Callable[[], object]:
        judging = {texts.CONFIRM: CONFIRMED, texts.REJECT: WRONG, texts.OTHER: OTHER_CAUSE}

        def buttons() -> None:
            if not self._visit.confirms:
                return
            for words, verdict in judging.items():
                self._button(words, episode, partial(self._found, episode, verdict))
            if episode.finding is not None:
                self._button(texts.UNDO, episode, partial(self._withdraw, episode))

        return buttons

    def _button(self, words: str, episode: FaultEpisode, work: Callable[[], object]) -> None:
        made = draw.button(words, lambda: self._state(work)).props("outline")
        made.props(f'aria-label="{words}: {texts.EPISODE.lower()} {episode.number}"')

    def _repair(self, history: History) -> None:
        known = self._visit.desk.robot(self._name)
        if known is None or not self._visit.confirms:
            return
        draw.heading(texts.NOTE_REPAIR)
        names = known.robot.motor_names
        with ui.row().classes("gap-4 items-end"):
            first = self._repaired or suspected_motor(history, names)
            motor = draw.Choice(names, first, texts.MOTOR, words=draw.spoken)
            part = _field(texts.PART)

            def work() -> None:
                told, person = _filled(part, texts.PART), _filled(self._person, texts.YOUR_NAME)
                note = _value(self._note)
                self._store.repaired(self._name, motor.value, part=told, person=person, note=note)
                self._repaired = motor.value  # stays chosen, so that it can be undone

            draw.button(texts.REPAIR, lambda: self._state(work))

            def undo() -> None:
                person = _filled(self._person, texts.YOUR_NAME)
                self._store.withdraw_repair(self._name, motor.value, person=person)

            draw.button(texts.UNDO_REPAIR, lambda: self._state(undo))

    def _rates(self, kind: str) -> None:
        """Draw the learned rates of the faults of this robot."""
        known = self._visit.desk.robot(self._name)
        if known is None:
            return
        draw.heading(texts.RATES)
        seen, ages = self._store.fleet_faults(kind), self._store.motor_ages(self._name)
        learned = LearnedRates.of(seen, paper_hypotheses(known.robot.motor_names), ages)
        draw.text(learned.line)
        draw.text(texts.RATE_NOTE).classes("soft")
        rows = [
            [
                *(plain_name(Hypothesis.parse(one.name)), one.ages, str(one.confirmed)),
                *(f"{one.hours / 24.0:.0f}", f"{1000.0 * one.mean_per_h:.2g}"),
                f"{one.factor:.2g}",
            ]
            for one in learned.rates
        ]
        draw.table(texts.RATE_COLUMNS, rows)


def _field(label: str, value: str = "") -> ui.input:
    return ui.input(label, value=value).props(f"maxlength={LONGEST}").classes("w-48")


def _value(field: ui.input) -> str:
    return str(field.value or "").strip()[:LONGEST]


def _filled(field: ui.input, label: str) -> str:
    """Return the value of a field that may not be empty.

    Raises:
        InputError: If it is empty.
    """
    value = _value(field)
    if not value:
        raise InputError(texts.FILL_IN.format(label=label))
    return value


def suspected_motor(history: History, motors: Sequence[str]) -> str:
    """Return the motor of the newest open episode that nobody refuted, else the first motor."""
    open_ones = [one.motor for one in history.episodes if one.until is None and not one.refuted]
    return next((motor for motor in reversed(open_ones) if motor in motors), motors[0])


def _timeline(visit: Visit, history: History) -> None:
    draw.heading(texts.TIMELINE)
    known = visit.desk.robot(history.robot)
    robot = None if known is None else known.robot
    rows = [
        [visit.time(one.at), one.kind, visit.words(one.text, robot)]
        for one in reversed(history.timeline)
    ]
    draw.table((texts.WHEN, texts.EVENT, texts.SAYS), rows)


def _compare(visit: Visit, history: History) -> None:
    """Draw the offsets of the motors at two dates."""
    draw.heading(texts.COMPARE)
    known = visit.desk.robot(history.robot)
    if not history.drifts or known is None:
        draw.text(texts.NO_OFFSETS)
        return
    days = sorted({visit.day(at) for one in history.drifts for at in one.at})

    def show_dates() -> None:
        place.clear()
        dates = [then.value, now.value]
        rows = [
            [draw.spoken(one.motor), one.name, *_at_dates(visit, one, dates)]
            for one in history.drifts
            if one.motor in known.robot.motor_names
        ]
        with place:
            draw.table((texts.MOTOR, texts.OFFSET, *dates, texts.CHANGE), rows)

    with ui.row().classes("gap-4"):
        then = draw.Choice(days, days[0], texts.THEN, show_dates)
        now = draw.Choice(days, days[-1], texts.NOW, show_dates)
    place = ui.element("div")
    show_dates()


def _at_dates(visit: Visit, drift: Drift, dates: list[str]) -> list[str]:
    """Return an offset at two dates, and the change between them."""
    known = visit.desk.known.robot
    values = []
    for day in dates:
        before = [k for k, at in enumerate(drift.at) if visit.day(at) <= day]
        values.append(before[-1] if before else 0)
    angle = drift.unit.startswith("rad") and drift.motor in known.motor_names

    def word(value: float, directed: bool = drift.name in DIRECTED) -> str:
        if angle:
            told = visit.difference(value, known, known.motor_names.index(drift.motor), directed)
            return told + drift.unit.removeprefix("rad")
        return f"{value:.4g} {drift.unit}"

    told = [f"{word(drift.values[k])} ± {word(drift.deviations[k], False)}" for k in values]
    change = drift.values[values[1]] - drift.values[values[0]]
    return [*told, word(change)]
