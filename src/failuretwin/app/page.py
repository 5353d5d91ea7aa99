"""One self-contained HTML page for the runs of a folder. Needs the extra `plots`."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin import __version__
from failuretwin.app.results import as_unknown_line, score_line
from failuretwin.core.diagnosis import Diagnosis
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.data_knowledge.knowledge import plain_name
from failuretwin.decision.metrics import judged_truth

if TYPE_CHECKING:
    from jinja2 import Environment


def write_page(
    diagnoses: Sequence[Diagnosis], pictures: Sequence[Path], robot: str, path: Path
) -> None:
    """Write the page; pictures are part of it.

    Args:
        diagnoses: Diagnoses of the runs.
        pictures: PNG file of each run, in the same order.
        robot: Name of the robot.
        path: HTML file to write.

    Raises:
        InputError: If jinja2 is missing.
    """
    template = (files("failuretwin.app") / "page.html.j2").read_text(encoding="utf-8")
    page = environment().from_string(template)
    records = [d.to_record() for d in diagnoses]
    text = page.render(
        runs=[_entry(d, picture) for d, picture in zip(diagnoses, pictures, strict=True)],
        robot=robot,
        method=diagnoses[0].method,
        protocol=diagnoses[0].protocol,
        version=__version__,
        known=any(d.truth is not None for d in diagnoses),
        score=score_line(records),
        as_unknown=as_unknown_line(records),
    )
    path.write_text(text, encoding="utf-8")


def environment() -> Environment:
    """Return what renders the templates of pages; text in them is escaped.

    Raises:
        InputError: If jinja2 is missing.
    """
    try:
        from jinja2 import Environment, StrictUndefined
    except ImportError as error:
        raise InputError(
            f"pages need jinja2 ({error}). Install it: pip install 'failuretwin[plots]'."
        ) from error
    return Environment(autoescape=True, undefined=StrictUndefined)


def _entry(diagnosis: Diagnosis, picture: Path) -> dict[str, Any]:
    truth = diagnosis.truth
    return {
        "name": diagnosis.run,
        "verdict": diagnosis.verdict,
        "truth": "" if truth is None else plain_name(Hypothesis.parse(truth)),
        "wrong": truth is not None
        and judged_truth(truth, diagnosis.posterior) != diagnosis.diagnosis,
        "explanation": diagnosis.explanation,
        "quality": diagnosis.quality,
        "picture": base64.b64encode(picture.read_bytes()).decode("ascii"),
    }
