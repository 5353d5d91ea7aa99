"""What `robot fit` shows: frames, senses, zeros and axes with their intervals, and what is open."""

from __future__ import annotations

from failuretwin.app.reports.tables import Table, show
from failuretwin.connection.calibration.result import Parameter
from failuretwin.connection.registration.fit import Registration

SHOWN = {"m": (1e3, "mm"), "rad": (57.29577951308232, "deg")}
"""Factor and name of the units that people read."""


def print_registration(found: Registration) -> None:
    """Print what was found and how far it can be trusted."""
    profile = found.profile
    show(f"{profile.name}: {found.poses} settled poses, the tool path alone\n")
    rows = [_row(parameter) for parameter in found.parameters]
    show(Table(("parameter", "value", "95 % interval", "unit", ""), rows, "lrrll"))
    show(
        "\nthe tool is off at the median: "
        f"{found.before_mm:.3g} mm with the profile as it was, {found.frames_mm:.3g} mm with "
        f"frame, tool point and zeros fitted, {found.after_mm:.3g} mm with the geometry too, in "
        "poses that the fit had not seen",
        f"the sensor and what no geometry explains: {1e3 * found.noise_m:.2g} mm on each axis",
    )
    if found.not_told:
        show("\nthe poses do not tell, and what the profile or the URDF says stands:")
        show(*(f"  {line}" for line in found.not_told))
    show(*(f"note: {line}" for line in found.remarks))


def _row(parameter: Parameter) -> tuple[str, ...]:
    factor, unit = SHOWN.get(parameter.unit, (1.0, parameter.unit))
    value, low, high = (
        f"{factor * x:.5g}" for x in (parameter.value, parameter.low, parameter.high)
    )
    title = f"{parameter.name}, {parameter.motor}" if parameter.motor else parameter.name
    known = "" if parameter.identified else "not identified"
    return title, value, f"{low} to {high}", unit, known
