"""Exports of the store, read by other programs' own readers."""

from __future__ import annotations

import subprocess
import sys
from datetime import UTC, datetime

import pytest
from basyx.aas import model
from basyx.aas.adapter import aasx
from basyx.aas.adapter.json import read_aas_json_file

import failuretwin as ft
from failuretwin.core.errors import InputError, OutputError
from failuretwin.data_knowledge.records.log_files import LogFile
from failuretwin.data_knowledge.records.offsets import MotorOffset
from store_places import diagnosis

NAME = "arm 7/ä"
DAY_S = 86_400


def day(number):
    return datetime.fromtimestamp(1_772_438_400 + DAY_S * number, UTC)


@pytest.fixture
def store(place):
    return ft.open_store(place.url, create=True)


@pytest.fixture
def robot(store, armpi):
    """A robot with a row in every table that its shell shows, null and odd texts among them."""
    for number, document in enumerate(("x = 1", 'x = "ä"\n')):
        of = {"protocol": "P0c", "profile": armpi, "valid_from": day(number)}
        kept = store.keep_calibration(NAME, document, name=f"c{number}", **of)
    names = ("motor_1:stuck", "healthy", "motor_2:stuck")
    for number, name in enumerate(names):
        zero = MotorOffset("motor_1", "zero", 0.1 + number / 3, 0.01, "rad")
        log = LogFile(f"/{number}", f"{number}", 1, day(number))
        given = [diagnosis(f"run <{number}>", name)]
        store.remember(given, NAME, log=log, calibration=kept.number, offsets=[zero])
    store.found(NAME, 1, "wrong", person="Ada")
    store.withdraw(NAME, 1)
    store.found(NAME, 1, "confirmed", cause="gear", note="a & <b>")
    store.repaired(NAME, "motor_1", part="gear", person="Ada", note="")
    return NAME


def read_shell(file):
    """Return the shell and the submodels of a file, by the SDK's strict reader."""
    if file.suffix == ".json":
        objects = read_aas_json_file(file, failsafe=False)
    else:
        objects, files = model.DictIdentifiableStore(), aasx.DictSupplementaryFileContainer()
        with aasx.AASXReader(file, failsafe=False) as reader:
            reader.read_into(objects, files)
    (shell,) = (one for one in objects if isinstance(one, model.AssetAdministrationShell))
    return shell, {one.id_short: one for one in (ref.resolve(objects) for ref in shell.submodel)}


def plain(element):
    """Return an element of a submodel as Python values."""
    if isinstance(element, model.SubmodelElementList):
        return [plain(one) for one in element.value]
    if isinstance(element, model.SubmodelElementCollection):
        return {one.id_short: plain(one) for one in element.value}
    if isinstance(element, model.MultiLanguageProperty):
        return dict(element.value)
    return element.value


def values(submodel):
    return {one.id_short: plain(one) for one in submodel.submodel_element}


def as_sql(row):
    """Return values of the shell as `SqlitePlace.sql` and `psql` print them."""
    return tuple(
        "" if cell is None else f"{cell:%Y-%m-%d %H:%M:%S}" if hasattr(cell, "year") else str(cell)
        for cell in row
    )


def seconds(rows):
    """Return rows of SQL with times cut to seconds."""
    return [tuple(c[:19] if c[4:5] == c[7:8] == "-" else c for c in row) for row in rows]


@pytest.mark.parametrize("suffix", [".json", ".aasx"])
def test_the_sdk_reads_every_value_of_a_shell(place, store, robot, tmp_path, suffix):
    file = tmp_path / f"arm{suffix}"
    names = store.export_shell(robot, file)
    shell, submodels = read_shell(file)
    assert names == ["Nameplate", "Calibration", "Health", "FaultHistory"]
    assert set(submodels) == set(names)
    asset = "urn:failuretwin:robot:arm%207%2F%C3%A4"
    assert shell.asset_information.global_asset_id == asset
    assert [one.value for one in shell.asset_information.specific_asset_id] == [robot]

    assert values(submodels["Nameplate"]) == {
        "URIOfTheProduct": asset,
        "ManufacturerProductDesignation": {"en": "armpi_fpv"},
    }

    found = values(submodels["Calibration"])
    rows = place.sql(
        "SELECT id, name, protocol, valid_from FROM calibrations WHERE valid_to IS NULL"
    )
    keys = ("Number", "Name", "Protocol", "ValidFrom")
    assert [as_sql(found[key] for key in keys)] == seconds(rows)
    assert found["Document"] == 'x = "ä"\n'.encode()

    health = values(submodels["Health"])
    assert health["Summary"] == "motor 2 stuck, raised, since 2026-03-04"
    assert health["OpenFaults"] == 1
    assert health["DiagnosedRuns"] == [
        {"State": "faulty", "Runs": 2},
        {"State": "healthy", "Runs": 1},
    ]
    assert health["LastDiagnosis"] == {
        "At": day(2),
        "Run": "run <2>",
        "State": "faulty",
        "Verdict": "motor_2:stuck for sure",
    }
    (zero,) = health["Offsets"]
    assert zero == {
        "Motor": "motor_1",
        "Name": "zero",
        "Unit": "rad",
        "At": day(2),
        "Mean": 0.1 + 2 / 3,
        "Deviation": 0.01,
    }

    faults = values(submodels["FaultHistory"])
    of = [
        (*(one[key] for key in ("Number", "Motor", "Mode", "Since")), one.get("Until"))
        for one in faults["Episodes"]
    ]
    rows = place.sql("SELECT number, motor, mode, since, until FROM episodes ORDER BY number")
    assert [as_sql(one) for one in of] == seconds(rows)
    assert [one["State"] for one in faults["Episodes"]] == ["cleared", "raised"]
    given = faults["Episodes"][0]["Findings"]
    rows = place.sql(
        "SELECT at, verdict, cause, person, note FROM findings WHERE withdraws IS NULL ORDER BY id"
    )
    keys = ("At", "Verdict", "Cause", "Person", "Note")
    assert [as_sql(one[key] for key in keys) for one in given] == seconds(rows)
    assert ["WithdrawnWhen" in one for one in given] == [True, False]
    rows = place.sql("SELECT at, motor, part, person, note FROM repairs")
    keys = ("At", "Motor", "Part", "Person", "Note")
    assert [as_sql(one[key] for key in keys) for one in faults["Repairs"]] == seconds(rows)


def test_the_nameplate_has_the_semantic_ids_of_its_template(store, robot, tmp_path):
    """IDTA 02006-3-0."""
    store.export_shell(robot, tmp_path / "arm.json")
    plate = read_shell(tmp_path / "arm.json")[1]["Nameplate"]
    found = {one.id_short: one.semantic_id.key[0].value for one in plate.submodel_element}
    assert plate.semantic_id.key[0].value == "https://admin-shell.io/idta/nameplate/3/0/Nameplate"
    assert found == {
        "URIOfTheProduct": "0112/2///61987#ABN590#002",
        "ManufacturerProductDesignation": "0112/2///61987#ABA567#009",
    }


def test_a_robot_of_which_little_is_known_has_a_shell(store, tmp_path):
    """Characters that XML cannot hold are replaced."""
    store.remember([diagnosis("run", "healthy")], NAME)
    store.repaired(NAME, "motor_1", note="bell \x07")
    store.export_shell(NAME, tmp_path / "arm.aasx")
    _, submodels = read_shell(tmp_path / "arm.aasx")
    assert values(submodels["Calibration"]) == {}
    assert values(submodels["FaultHistory"])["Repairs"][0]["Note"] == "bell \ufffd"


def test_a_shell_that_cannot_be_written_gives_one_line(store, robot, tmp_path):
    with pytest.raises(InputError, match=r"suffix '.xml', expected .aasx or .json"):
        store.export_shell(robot, tmp_path / "arm.xml")
    with pytest.raises(OutputError, match="does not exist"):
        store.export_shell(robot, tmp_path / "no" / "arm.json")
    with pytest.raises(InputError, match="unknown robot 'arm_9'"):
        store.export_shell("arm_9", tmp_path / "arm.json")
    assert list(tmp_path.glob("arm.*")) == []


def test_without_the_sdk_the_extra_is_named(tmp_path):
    code = (
        "import sys; sys.modules['basyx.aas'] = None\n"
        "import failuretwin as ft\n"
        "store = ft.open_store('a.db', create=True)\n"
        "store.keep_calibration('a', 'x = 1', name='c', protocol='P0c')\n"
        "try: store.export_shell('a', 'a.json')\n"
        "except ft.InputError as error: print(error)\n"
    )
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path)
    assert done.stdout.endswith("Install it: pip install 'failuretwin[aas]'.\n"), done.stderr


def test_duckdb_reads_every_table_of_the_export(place, store, robot, tmp_path):
    duckdb = pytest.importorskip("duckdb", reason="DuckDB is not installed")
    counts = store.export(tmp_path / "tables")
    with duckdb.connect() as connection:
        for table, count in counts.items():
            query = f"SELECT count(*) FROM '{tmp_path}/tables/{table}.parquet'"
            assert connection.sql(query).fetchall() == [(count,)]
        found = connection.sql(
            "SELECT motor, epoch(since), epoch(until) "
            f"FROM '{tmp_path}/tables/episodes.parquet' ORDER BY number"
        ).fetchall()
    begun = [day(number).timestamp() for number in range(3)]
    assert found == [("motor_1", begun[0], begun[1]), ("motor_2", begun[2], None)]
