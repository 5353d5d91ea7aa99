"""The registry of modes, distributions from files, and the page that describes both."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from failuretwin.core.errors import InputError
from failuretwin.failure_behavior import registry
from failuretwin.failure_behavior.modes import Drift, Lag, Stuck
from failuretwin.failure_behavior.registry import MODES, load_modes, register_mode
from user_modes import code_on_the_page, registered_from

PAGE = Path(__file__).parents[2] / "docs" / "fault_modes.md"


@pytest.fixture(scope="module")
def page():
    return PAGE.read_text("utf-8").partition("## A mode of your own")[0]


@pytest.fixture
def load(tmp_path):
    def load(text):
        path = tmp_path / "faults.toml"
        path.write_text(text)
        return load_modes(path)

    return load


def test_modes_go_by_their_ids():
    assert all(name == mode.mode for name, mode in MODES.items())


def test_the_table_on_the_page_is_what_the_modes_are(page):
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line[:3] == "| `"]
    assert [row[0].strip("`") for row in rows] == list(MODES)
    for row, mode in zip(rows, MODES.values(), strict=True):
        *_, default, profiles = row
        assert tuple(re.findall(r"\w+", profiles)) == mode.allowed_profiles
        assert tuple(re.findall(r"\*\*(\w+)\*\*", profiles)) == mode.profiles
        if mode.mode != "stuck":
            low, high = re.search(r"([\d.]+) to ([\d.]+)", default).groups()
            assert (float(low), float(high)) == pytest.approx(mode.magnitude, abs=5e-4)
        if mode.mode not in ("stuck", "steady_state_error"):
            assert mode.onset_s == (0.0, 5.0)


def test_the_example_on_the_page_loads(page, load):
    (text,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    modes = load(text)
    assert modes["drift"] == Drift(
        magnitude=(0.02, 0.02),
        both_signs=False,
        onset_s=(0.0, 2.0),
        profiles=("step", "ramp"),
        rise_s=(1.0, 4.0),
    )
    assert modes["stuck"] == Stuck(onset_s=(1.0, 8.0), profiles=("intermittent",))
    assert {name: modes[name] for name in MODES.keys() - {"drift", "stuck"}} == {
        name: mode for name, mode in MODES.items() if name not in ("drift", "stuck")
    }


def test_loading_changes_no_defaults(load):
    before = dict(MODES)
    assert load("[lag]\nmagnitude = [0.2, 0.2]\n")["lag"] == Lag(magnitude=(0.2, 0.2))
    assert before == MODES


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[stuk]\n", "unknown fault mode 'stuk'. Did you mean 'stuck'"),
        ("[lag]\nmagnitude = [0.1, 0.2, 0.3]\n", "lag: magnitude is .* expected 2 values"),
        ("[lag]\nmagnitude = [-0.1, 0.2]\n", "lag: magnitude is .* between 0 and inf"),
        # What a mode has no use for is no option of it.
        ("[stuck]\nmagnitude = [0.1, 0.2]\n", "stuck: unknown key 'magnitude'"),
        ("[stuck]\nrise_s = [1, 2]\n", "stuck: unknown key 'rise_s'"),
        ("[intermittent]\nepisode_share = [0.1, 0.2]\n", "unknown key 'episode_share'"),
        ("[backlash]\nepisode_s = [1, 2]\n", "backlash: unknown key 'episode_s'"),
    ],
)
def test_bad_files_are_refused_by_name(load, text, message):
    with pytest.raises(InputError, match=rf"faults\.toml: .*{message}"):
        load(text)


def test_a_name_is_given_once():
    before = dict(MODES)
    with pytest.raises(InputError, match="there is a fault mode 'lag' already"):
        register_mode(Lag())
    assert before == MODES


def test_an_installed_package_makes_its_modes_known(monkeypatch, tmp_path):
    """By an entry point of the group `failuretwin.modes`, read once, with the first mode."""
    name = "installed_shafts"
    (tmp_path / f"{name}.py").write_text(code_on_the_page().replace("bent_shaft", "bent_axle"))
    monkeypatch.syspath_prepend(tmp_path)
    entry = EntryPoint("axles", name, "failuretwin.modes")
    found = []
    monkeypatch.setattr(registry, "entry_points", lambda group: found.append(group) or [entry])
    fresh = registry.ModeRegistry()
    monkeypatch.setattr(registry, "MODES", fresh)
    assert found == []
    assert list(fresh) == [*MODES, "bent_axle"]
    assert fresh["bent_axle"].unit == "rad"
    assert found == ["failuretwin.modes"]


def test_a_module_that_is_run_again_replaces_its_mode(tmp_path):
    with registered_from(code_on_the_page(), tmp_path, "run_again") as mode:
        register_mode(type(mode)(magnitude=(0.1, 0.2)))
        assert MODES[mode.mode].magnitude == (0.1, 0.2)


def test_an_installed_module_may_be_imported_before_the_modes_are_asked_for(tmp_path):
    """As in a worker process, which unpickles a plan with a mode of its own."""
    (tmp_path / "installed_mode.py").write_text(code_on_the_page())
    info = tmp_path / "installed_mode-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: installed-mode\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[failuretwin.modes]\nshaft = installed_mode\n")
    code = (
        "import installed_mode\n"
        "from failuretwin.failure_behavior.registry import MODES\n"
        "print('bent_shaft' in MODES, len(MODES))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["True", "12"]
