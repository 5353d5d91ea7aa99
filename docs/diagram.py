"""Draw which package imports which, from the code: `python docs/diagram.py`."""

from __future__ import annotations

import ast
from pathlib import Path

HERE = Path(__file__).parent
PACKAGE = HERE.parent / "src" / "failuretwin"
PICTURE = HERE / "images" / "packages.svg"
PACKAGES = {
    "core": "runs, movements, diagnoses",
    "digital_model": "1  kinematics, servos, physics",
    "failure_behavior": "2  fault modes, injection",
    "data_knowledge": "3  readers, stores, simulation",
    "inference": "likelihood, posterior",
    "connection": "4  live links, calibration",
    "decision": "5  streams, networks, acting",
    "app": "commands, pages",
}
"""Packages in import order and their contents; numbers: modules of the paper."""
WIDTH, ROW, BOX = 640, 56, 40


def imports() -> set[tuple[str, str]]:
    """Return the pairs (importing package, imported package)."""
    found = set()
    for package in PACKAGES:
        for path in (PACKAGE / package).rglob("*.py"):
            nodes = list(ast.walk(ast.parse(path.read_text("utf-8"))))
            names = [n.module or "" for n in nodes if isinstance(n, ast.ImportFrom)]
            names += [a.name for n in nodes if isinstance(n, ast.Import) for a in n.names]
            others = {name.split(".")[1] for name in names if name.startswith("failuretwin.")}
            found |= {(package, other) for other in others & PACKAGES.keys() - {package}}
    return found


def picture(found: set[tuple[str, str]]) -> str:
    """Return the SVG: one box per package, one arc per import."""
    rows = {name: ROW * number + ROW // 2 for number, name in enumerate(reversed(PACKAGES))}
    boxes = [_box(name, text, rows[name]) for name, text in PACKAGES.items()]
    arcs = [_arc(*pair, rows) for pair in sorted(found)]
    height = ROW * len(PACKAGES)
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
            'font-family="sans-serif" font-size="13">',
            "<title>Packages of failuretwin; an arc leads from a package down to one that it "
            "imports</title>",
            f'<rect width="{WIDTH}" height="{height}" fill="white"/>',
            *arcs,
            *boxes,
            "</svg>\n",
        ]
    )


def _box(name: str, text: str, y: int) -> str:
    return (
        f'<rect x="10" y="{y - BOX // 2}" width="370" height="{BOX}" rx="6" fill="#e8eef7" '
        f'stroke="#36507a"/><text x="22" y="{y + 5}" font-weight="bold">{name}</text>'
        f'<text x="160" y="{y + 5}">{text}</text>'
    )


def _arc(importing: str, imported: str, rows: dict[str, int]) -> str:
    above, below = rows[importing] + 6, rows[imported] - 6
    out = 400 + 0.55 * (below - above)
    return (
        f'<path d="M380 {above} C{out:.0f} {above} {out:.0f} {below} 380 {below}" fill="none" '
        f'stroke="#7a8fb3" stroke-width="1.5"><title>{importing} imports {imported}</title></path>'
        f'<path d="M380 {below} l8 -4 l0 8 z" fill="#36507a"/>'
    )


if __name__ == "__main__":
    PICTURE.write_text(picture(imports()), "utf-8")
    print(f"{PICTURE}: written")
