from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import pytest

from failuretwin.core.config import Bounded, Bounds, from_table, read_toml
from failuretwin.core.errors import InputError


@dataclass(frozen=True)
class Wheel:
    radius: float
    spokes: int = 8


@dataclass(frozen=True)
class Cart:
    name: str
    wheels: tuple[Wheel, ...] = ()
    size: tuple[float, float] = (1.0, 1.0)
    brake: Wheel | None = None
    speed: float | None = None
    painted: bool = False
    sources: dict[str, str] = field(default_factory=dict)


def test_defaults_stand_for_missing_keys():
    assert from_table(Cart, {"name": "a"}, "cart.toml") == Cart("a")


def test_every_kind_of_field_is_read():
    table = {
        "name": "a",
        "wheels": [{"radius": 1}, {"radius": 0.5, "spokes": 12}],
        "size": [2, 3],
        "brake": {"radius": 0.1},
        "speed": 4,
        "painted": True,
        "sources": {"radius": "measured"},
    }
    assert from_table(Cart, table, "cart.toml") == Cart(
        "a", (Wheel(1.0), Wheel(0.5, 12)), (2.0, 3.0), Wheel(0.1), 4.0, True, {"radius": "measured"}
    )


def test_whole_numbers_become_floats_where_a_float_is_meant():
    assert isinstance(from_table(Wheel, {"radius": 1}, "wheel.toml").radius, float)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"nmae": "b"},
            "cart.toml: unknown key 'nmae'. Did you mean 'name'? "
            "Valid: name, wheels, size, brake, speed, painted, sources.",
        ),
        (
            {"wheels": [{"radius": 1.0}, {"radius": 1.0, "spoke": 3}]},
            "cart.toml: wheels[1]: unknown key 'spoke'. Did you mean 'spokes'? "
            "Valid: radius, spokes.",
        ),
        ({"wheels": [{}]}, "cart.toml: wheels[0]: key 'radius' is missing. Add it."),
        ({"name": 3}, "cart.toml: name is 3, expected text."),
        ({"painted": 1}, "cart.toml: painted is 1, expected true or false."),
        ({"speed": "fast"}, "cart.toml: speed is 'fast', expected a number."),
        ({"speed": True}, "cart.toml: speed is True, expected a number."),
        (
            {"brake": {"radius": 1.0, "spokes": 2.5}},
            "cart.toml: brake: spokes is 2.5, expected a whole number.",
        ),
        (
            {"brake": {"radius": 1.0, "spokes": True}},
            "cart.toml: brake: spokes is True, expected a whole number.",
        ),
        ({"size": [1.0]}, "cart.toml: size is [1.0], expected 2 values."),
        ({"size": 1.0}, "cart.toml: size is 1.0, expected a list."),
        ({"brake": [1.0]}, "cart.toml: brake is [1.0], expected a table."),
        ({"sources": "here"}, "cart.toml: sources is 'here', expected a table."),
        ({"sources": {"radius": 1}}, "cart.toml: sources.radius is 1, expected text."),
    ],
)
def test_wrong_tables_say_where_and_what_is_expected(change, message):
    with pytest.raises(InputError) as error:
        from_table(Cart, {"name": "a"} | change, "cart.toml")
    assert str(error.value) == message


@dataclass(frozen=True)
class Road(Bounded):
    slope: Annotated[float, Bounds(-0.5, 0.5)] = 0.0
    widths: Annotated[tuple[float, ...], Bounds(2.0, 9.0)] = ()
    speed: Annotated[tuple[float, float], Bounds(0.0, 100.0, in_order=True)] = (0.0, 0.0)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"slope": -0.6}, "slope is -0.6, expected a number from -0.5 to 0.5."),
        ({"slope": math.nan}, "slope is nan, expected a number from -0.5 to 0.5."),
        ({"widths": [3.0, 1.5]}, "widths is 1.5, expected a number from 2 to 9."),
        (
            {"speed": [50.0, 30.0]},
            "speed is [50, 30], expected the lowest and the highest value, in order, "
            "from 0 to 100.",
        ),
        (
            {"speed": [50, 101]},
            "speed is [50, 101], expected the lowest and the highest value, in order, "
            "from 0 to 100.",
        ),
    ],
)
def test_numbers_outside_their_bounds_are_refused(table, message):
    with pytest.raises(InputError) as error:
        from_table(Road, table, "road.toml")
    assert str(error.value) == f"road.toml: {message}"


def test_bounds_themselves_are_allowed():
    assert Road(0.5, (2.0, 9.0), (100.0, 100.0)).slope == 0.5


def test_toml_file_is_read(tmp_path):
    path = tmp_path / "cart.toml"
    path.write_text('name = "a"\nsize = [1, 2]\n')
    assert read_toml(path) == {"name": "a", "size": [1, 2]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read"),
        (b"\xff\xfe", "cannot be read"),
        (b"name = ", "not a TOML file"),
    ],
)
def test_files_that_are_not_toml_are_named(tmp_path, content, message):
    path = tmp_path / "cart.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as error:
        read_toml(path)
    assert str(error.value).startswith(f"{path}: {message}")
