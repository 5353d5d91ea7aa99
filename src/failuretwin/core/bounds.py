"""Numbers that must lie within bounds: an error says which, what it is and what was expected."""

from __future__ import annotations

from failuretwin.core.errors import InputError


def check_number(name: str, value: float, low: float = 0.0, high: float = 1e6) -> None:
    """Raise InputError unless `value` is a number from `low` to `high`."""
    if not low <= value <= high:
        raise InputError(f"{name} is {value:g}, expected a number from {low:g} to {high:g}.")


def check_share(name: str, value: float) -> None:
    """Raise InputError unless `value` is a share, from 0 to 1."""
    check_number(name, value, 0.0, 1.0)


def check_range(
    name: str, values: tuple[float, float], low: float = 0.0, high: float = 1e6
) -> None:
    """Raise InputError unless `values` are a lowest and a highest within bounds, in order."""
    if not low <= values[0] <= values[1] <= high:
        raise InputError(
            f"{name} is [{values[0]:g}, {values[1]:g}], expected the lowest and the highest value, "
            f"in order, from {low:g} to {high:g}."
        )
