"""One self-contained HTML page from which an engineer judges a calibration. Needs `plots`."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from failuretwin import __version__
from failuretwin.app.calibration_plots import (
    channels,
    expected_figure,
    load_figure,
    png,
    quantile_figure,
    ramp_figure,
    session_figure,
)
from failuretwin.app.calibration_rows import parameter_groups
from failuretwin.app.calibration_tables import left_out_line, mean_gain, verdict_line
from failuretwin.app.page import environment
from failuretwin.connection.calibration.calibration import Calibration
from failuretwin.connection.calibration.example_ramp import example_ramp
from failuretwin.connection.calibration.predictions import Predictions, predict, settling_of
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class _Picture:
    """A picture with its words.

    Attributes:
        title: Heading.
        caption: How to read it.
        data: PNG file in base64.
    """

    title: str
    caption: str
    data: str


def write_calibration_page(
    found: Calibration, runs: xr.Dataset, robot: Robot, folder: Path
) -> None:
    """Write `index.html` with tables and pictures into `folder`.

    Args:
        found: The calibration.
        runs: The runs it was learned from or judged on.
        robot: The robot.
        folder: An existing folder.

    Raises:
        InputError: If jinja2 or matplotlib is missing.
    """
    template = (files("failuretwin.app") / "calibration.html.j2").read_text(encoding="utf-8")
    pictures = dict(_pictures(found, runs, robot))
    names, scale, unit = channels(robot, found.used_readings)
    page = environment().from_string(template)
    text = page.render(
        found=found,
        robot=robot.name,
        version=__version__,
        verdict=verdict_line(found).rstrip("."),
        grade=_grade(found),
        groups=parameter_groups(found, robot),
        count_deg=_count_degrees(robot),
        left_out=left_out_line(found),
        pictures=pictures,
        channels=names,
        unit=unit,
        scale=scale,
        payload=settling_of(found, robot).payload,
    )
    (folder / "index.html").write_text(text, encoding="utf-8")


def _grade(found: Calibration) -> str:
    """Return whether unseen sessions speak for the calibration: good, bad or unknown."""
    if not found.held_out:
        return "unknown"
    gain, half = mean_gain(found.held_out)
    return "good" if gain - half > 0.0 else "bad"


def _count_degrees(robot: Robot) -> float | None:
    """Return the size of a servo count [deg], positive if counts run against angles."""
    units = robot.profile.servo_units
    return None if units is None else units.deg_per_count


def _pictures(found: Calibration, runs: xr.Dataset, robot: Robot) -> Iterator[tuple[str, _Picture]]:
    seen, settling = predict(found, runs, robot), settling_of(found, robot)
    if found.held_out:
        yield (
            "sessions",
            _picture(
                png(session_figure(found.held_out, robot, found.used_readings)),
                "Size of the settled error by session",
                "1.48 times the median size of the error, the shorter the better.",
            ),
        )
    if seen.counts.any():
        yield (
            "expected",
            _picture(
                png(expected_figure(seen, robot)),
                "Settled error against prediction",
                "The uncalibrated twin expects no error at all (grey line); a perfect calibration "
                f"puts every point on the blue one. {_who_predicts(seen)} Above each panel: size "
                "of the error before and after.",
            ),
        )
        yield (
            "quantiles",
            _picture(
                png(quantile_figure(seen, settling.tail_dof, robot)),
                "Distribution of what is left",
                f"Against a Student t with {settling.tail_dof:.1f} degrees of freedom. Points that "
                "leave the band upwards on the right or downwards on the left are larger errors "
                f"than the calibration allows for. {_who_predicts(seen)}",
            ),
        )
    if seen.of_motors and seen.counts.any():
        yield (
            "load",
            _picture(
                png(load_figure(seen, settling, robot)),
                "What the arm's weight and friction do",
                "Settled error before calibration, one point a movement. The slope of the lines is "
                "the compliance, half their distance the friction, and their middle at no load the "
                "bias.",
            ),
        )
    ramp = example_ramp(found, runs, robot)
    if ramp is not None:
        yield (
            "ramp",
            _picture(
                png(ramp_figure(ramp, robot)),
                f"A ramp: {ramp.run}, movement {ramp.movement}",
                "The movement with the median misfit of the longer half of all that began on time.",
            ),
        )


def _who_predicts(seen: Predictions) -> str:
    if seen.unseen:
        return "Each session is predicted by a fit that has not seen it."
    return "These movements are those that the fit has seen: there is no other session."


def _picture(data: bytes, title: str, caption: str) -> _Picture:
    return _Picture(title, caption, base64.b64encode(data).decode("ascii"))
