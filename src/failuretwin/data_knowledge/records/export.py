"""Exports: all tables of the store as parquet, and one robot as an asset administration shell.

Parquet, one file a table, is for pandas, DuckDB and the like. The shell (AAS), by the Eclipse BaSyx
SDK, has four submodels: nameplate, calibration in force, health, and fault history. The nameplate
has the semantic ids of IDTA 02006-3-0 (Digital Nameplate) for what the store knows.

Section: docs/store.md#asset-administration-shell
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import sqlalchemy as sa

from failuretwin.core.errors import InputError, needs_extra
from failuretwin.data_knowledge.records.history import FaultEpisode, History
from failuretwin.data_knowledge.records.schema import Utc, metadata
from failuretwin.data_knowledge.store import filling, replacing

if TYPE_CHECKING:
    import pyarrow as pa
    from basyx.aas import model

CHUNK_ROWS = 20_000
"""Rows in memory at a time."""


def export_parquet(connection: sa.Connection, folder: Path) -> dict[str, int]:
    """Write every table to `TABLE.parquet` in a folder; all files appear together.

    Times are UTC, JSON columns are text.

    Returns:
        Number of rows of each table.

    Raises:
        InputError: If pyarrow is missing.
        OutputError: If they cannot be written; the folder is as before.
    """
    with needs_extra("parquet needs pyarrow", "store"):
        import pyarrow.parquet
    del pyarrow
    with filling(folder) as partial:
        return {
            table.name: _write_table(connection, table, partial / f"{table.name}.parquet")
            for table in metadata.sorted_tables
        }


def _write_table(connection: sa.Connection, table: sa.Table, file: Path) -> int:
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema, count = _arrow_schema(table), 0
    query = sa.select(table).order_by(table.c.id).execution_options(yield_per=CHUNK_ROWS)
    with pq.ParquetWriter(file, schema) as writer:
        for rows in connection.execute(query).mappings().partitions():
            cells = [_cells(row) for row in rows]
            writer.write_table(pa.Table.from_pylist(cells, schema))
            count += len(cells)
    return count


def _cells(row: Mapping[Any, Any]) -> dict[str, Any]:
    return {
        str(name): json.dumps(value, ensure_ascii=False)
        if isinstance(value, dict | list)
        else value
        for name, value in row.items()
    }


def _arrow_schema(table: sa.Table) -> pa.Schema:
    import pyarrow as pa

    def kind(column: sa.Column[Any]) -> pa.DataType:
        if isinstance(column.type, Utc):
            return pa.timestamp("us", tz="UTC")
        if isinstance(column.type, sa.Integer):
            return pa.int64()
        if isinstance(column.type, sa.LargeBinary):
            return pa.binary()
        return pa.float64() if isinstance(column.type, sa.Double) else pa.string()

    return pa.schema(
        [pa.field(one.name, kind(one), nullable=bool(one.nullable)) for one in table.columns]
    )


# The asset administration shell.

FORMATS = (".aasx", ".json")
"""Suffixes of the files: a package, or the bare JSON document."""
URN = "urn:failuretwin"
NAMEPLATE = "https://admin-shell.io/idta/nameplate/3/0/Nameplate"
"""Semantic id of the submodel template."""
NAMEPLATE_ELEMENTS = {
    "URIOfTheProduct": "0112/2///61987#ABN590#002",
    "ManufacturerProductDesignation": "0112/2///61987#ABA567#009",
}
"""Semantic ids of its elements (IEC CDD)."""
LANGUAGE = "en"
NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML cannot hold; U+FFFD takes their place."""

Content = Mapping[str, Any]
"""Elements by name: a text, number, instant or bytes, a `Content`, or a list of them."""


def export_shell(history: History, file: Path) -> list[str]:
    """Write a robot to an ``.aasx`` or ``.json`` file, and return the names of the submodels.

    Times are UTC. A value that is not known has no element.

    Raises:
        InputError: If the SDK is missing, or the suffix is another.
        OutputError: If the file cannot be written; it is as before.
    """
    if file.suffix.lower() not in FORMATS:
        raise InputError(f"{file}: has suffix {file.suffix!r}, expected {' or '.join(FORMATS)}.")
    with needs_extra("asset administration shells need basyx-python-sdk", "aas"):
        from basyx.aas import model
        from basyx.aas.adapter import aasx
        from basyx.aas.adapter import json as aas_json
    shell, submodels = _shell(history)
    objects = model.DictIdentifiableStore[model.Identifiable]([shell, *submodels])
    with replacing(file) as partial:
        if file.suffix.lower() == ".json":
            aas_json.write_aas_json_file(str(partial), objects)
        else:
            with aasx.AASXWriter(str(partial), failsafe=False) as writer:
                writer.write_aas(shell.id, objects, aasx.DictSupplementaryFileContainer())
    return [str(one.id_short) for one in submodels]


def _shell(history: History) -> tuple[model.AssetAdministrationShell, list[model.Submodel]]:
    from basyx.aas import model

    name = quote(history.robot, safe="")
    asset = f"{URN}:robot:{name}"
    contents: dict[str, Content] = {
        "Nameplate": {
            "URIOfTheProduct": asset,
            "ManufacturerProductDesignation": history.kind or None,
        },
        "Calibration": _calibration(history),
        "Health": _health(history),
        "FaultHistory": _faults(history),
    }
    submodels = [
        model.Submodel(
            f"{URN}:submodel:{name}:{kind}",
            _elements(content, NAMEPLATE_ELEMENTS if kind == "Nameplate" else {}),
            id_short=kind,
            semantic_id=_meaning(
                NAMEPLATE if kind == "Nameplate" else f"{URN}:semantics:{kind}:1:0"
            ),
        )
        for kind, content in contents.items()
    ]
    shell = model.AssetAdministrationShell(
        model.AssetInformation(
            model.AssetKind.INSTANCE,
            global_asset_id=asset,
            specific_asset_id=[model.SpecificAssetId("robot", _text(history.robot))],
        ),
        f"{URN}:shell:{name}",
        id_short="Robot",
        submodel={model.ModelReference.from_referable(one) for one in submodels},
    )
    return shell, submodels


# Contents of the submodels.


def _fields(value: Any, *names: str) -> dict[str, Any]:
    """Return attributes of a value as elements, whose names are those in camel case."""
    camel = {name: "".join(map(str.capitalize, name.split("_"))) for name in names}
    return {camel[name]: getattr(value, name) for name in names}


def _calibration(history: History) -> Content:
    """Return the calibration in force; empty: the robot has none."""
    found = next((one for one in history.calibrations if one.valid_to is None), None)
    if found is None:
        return {}
    stated = _fields(found, "number", "name", "protocol", "valid_from")
    return {**stated, "Document": found.document.encode()}


def _health(history: History) -> Content:
    """Return the state of the robot: sentence, counts, last diagnosis, last offsets [unit]."""
    content: dict[str, Any] = {
        "Summary": history.health,
        "OpenFaults": len(history.open_episodes),
        "DiagnosedRuns": [
            {"State": state, "Runs": count} for state, count in sorted(history.counts.items())
        ],
        "Offsets": [
            {
                **_fields(one, "motor", "name", "unit"),
                "At": one.at[-1],
                "Mean": one.values[-1],
                "Deviation": one.deviations[-1],
            }
            for one in history.drifts
        ],
    }
    for last in history.recent[-1:]:
        content["LastDiagnosis"] = _fields(last, "at", "run", "state", "verdict")
    return content


def _faults(history: History) -> Content:
    repaired = ("at", "motor", "part", "person", "note")
    return {
        "Episodes": [_episode(one) for one in history.episodes],
        "Repairs": [_fields(one, *repaired) for one in history.repairs],
    }


def _episode(episode: FaultEpisode) -> Content:
    found = ("at", "verdict", "cause", "person", "note", "withdrawn_when")
    return {
        **_fields(episode, "number", "motor", "mode", "state", "since", "until"),
        "Findings": [_fields(one, *found) for one in episode.findings],
    }


# Elements of BaSyx.


def _elements(content: Content, meanings: Mapping[str, str]) -> list[model.SubmodelElement]:
    return [
        _element(name, value, _meaning(meanings[name]) if name in meanings else None)
        for name, value in content.items()
        if value is not None
    ]


def _element(
    name: str, value: Any, meaning: model.ExternalReference | None
) -> model.SubmodelElement:
    from basyx.aas import model

    if isinstance(value, Mapping):
        return model.SubmodelElementCollection(name, _elements(value, {}), semantic_id=meaning)
    if isinstance(value, bytes):
        return model.Blob(name, "application/toml", value, semantic_id=meaning)
    if isinstance(value, list):
        rows = [model.SubmodelElementCollection(None, _elements(row, {})) for row in value]
        kind = model.SubmodelElementCollection
        return model.SubmodelElementList(name, kind, rows, semantic_id=meaning)
    if name == "ManufacturerProductDesignation":
        text = model.MultiLanguageTextType({LANGUAGE: _text(value)})
        return model.MultiLanguageProperty(name, text, semantic_id=meaning)
    if name == "URIOfTheProduct":
        uri = model.datatypes.AnyURI(value)
        return model.Property(name, model.datatypes.AnyURI, uri, semantic_id=meaning)
    if isinstance(value, str):
        value = _text(value)
    return model.Property(name, type(value), value, semantic_id=meaning)


def _text(text: str) -> str:
    return NOT_XML.sub("\ufffd", text)


def _meaning(identifier: str) -> model.ExternalReference:
    from basyx.aas import model

    key = model.Key(model.KeyTypes.GLOBAL_REFERENCE, identifier)
    return model.ExternalReference((key,))
