"""Draws docs/house.svg: the rooms of fusiond by floor, and which room imports which.

An N2 chart (R. Lano, The N2 Chart, TRW, 1977): rooms on the diagonal in the order of their floors,
which is that of the contract in pyproject.toml. A room's imports leave it to the right, and each
turns down at a dot into the room that it imports. An import against the contract would run up on
the left, in red. Only whether a room imports another is drawn: the picture changes when the house
does.

Usage: python tools/house.py [--check]; --check writes nothing and fails where the picture is old.
"""

from __future__ import annotations

import ast
import sys
import textwrap
import tomllib
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import grimp

REPOSITORY = Path(__file__).resolve().parents[1]
PICTURE = REPOSITORY / "docs" / "house.svg"

ROW, COLUMN, BOX, HEIGHT = 30, 30, 100, 22
TEXT, TOP, MARGIN = 330, 88, 16
LETTER = 6.2
"""Width of a letter of the sentences, on average, in the widest of the fonts."""
INK, LINE, BAND, WRONG = "#1b2733", "#7d96ad", "#f2f5f8", "#c62828"
HEADLINE = "The house: every room imports only from rooms below it"


@dataclass(frozen=True, slots=True)
class Room:
    """A package, the floor it is on (0 is the top) and the first sentence of its docstring."""

    name: str
    floor: int
    sentence: str


@dataclass(frozen=True, slots=True)
class House:
    """Rooms from the top floor down, and the arrows between them by name."""

    rooms: tuple[Room, ...]
    arrows: frozenset[tuple[str, str]]


def floors(pyproject: Path) -> list[list[str]]:
    """Rooms of `fusiond` by floor, from the top: the layers of the contract `floors`."""
    contracts = tomllib.loads(pyproject.read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = (c["layers"] for c in contracts if c["id"] == "floors")
    return [[room.strip(" ()") for room in layer.split("|")] for layer in layers]


def survey(repository: Path) -> House:
    """The house as the sources are: rooms that exist, arrows that are imported."""
    places = {"fusiond": repository / "fusiond"}
    levels = [["fusiond"]]
    for floor in floors(repository / "pyproject.toml"):
        found = {f"fusiond.{name}": repository / "fusiond" / name for name in floor}
        found = {name: path for name, path in found.items() if path.is_dir()}
        places |= found
        if found:
            levels.append(list(found))
    places["drivers"] = repository / "drivers"
    levels.append(["drivers"])
    rooms = [
        Room(name, level, _sentence(places[name] / "__init__.py"))
        for level, names in enumerate(levels)
        for name in names
    ]
    graph = grimp.build_graph("fusiond", "drivers", cache_dir=None)
    arrows = {
        (a, b)
        for module in graph.modules
        for imported in graph.find_modules_directly_imported_by(module)
        if (a := _room_of(module, places)) != (b := _room_of(imported, places))
    }
    return House(tuple(rooms), frozenset(arrows))


def _room_of(module: str, rooms: dict[str, Path]) -> str:
    parts = module.split(".")
    return room if (room := ".".join(parts[:2])) in rooms else parts[0]


def _sentence(source: Path) -> str:
    """Of a package's docstring, up to the first full stop or the end of its first line."""
    text = ast.get_docstring(ast.parse(source.read_text())) or ""
    return text.partition("\n")[0].partition(". ")[0].rstrip(".")


def draw(house: House) -> str:
    """The picture as SVG; the same house gives the same text."""
    rooms, at = house.rooms, {room.name: row for row, room in enumerate(house.rooms)}
    left = MARGIN + TEXT + BOX
    width = left + COLUMN * (len(rooms) - 1) + 90
    height = TOP + ROW * len(rooms) + MARGIN
    up = sum(at[a] > at[b] for a, b in house.arrows)
    count = f"{len(rooms)} rooms, {rooms[-1].floor + 1} floors, {len(house.arrows)} arrows"
    count += f", {up} of them up" if up else ", all of them down"
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}"'
        ' font-family="Helvetica, Arial, DejaVu Sans, sans-serif" font-size="12">',
        f"<title>{HEADLINE}</title>",
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        _text(MARGIN, 30, HEADLINE, 'font-size="18" font-weight="bold"'),
        _text(MARGIN, 50, f"{count}. A dot: the room on the left imports the room below."),
        _text(width - 12, TOP - 10, "imports · is imported by", 'text-anchor="end"'),
    ]
    for row, room in enumerate(rooms):
        if room.floor % 2 == 0:
            box = f'x="0" y="{TOP + row * ROW}" width="{width}" height="{ROW}"'
            parts.append(f'<rect {box} fill="{BAND}"/>')
    parts += _lines(house, at, left)
    for row, room in enumerate(rooms):
        middle = TOP + row * ROW + ROW // 2
        right = left + row * COLUMN
        imports = sum(a == room.name for a, _ in house.arrows)
        imported = sum(b == room.name for _, b in house.arrows)
        box = f'x="{right - BOX}" y="{middle - HEIGHT // 2}" width="{BOX}" height="{HEIGHT}"'
        parts += [
            f'<rect {box} rx="3" fill="#dce8f3" stroke="{INK}"/>',
            _text(
                right - BOX // 2,
                middle + 4,
                room.name.removeprefix("fusiond."),
                'text-anchor="middle" font-weight="bold"',
            ),
            *_sentence_lines(room.sentence, right - BOX - MARGIN, middle),
            _text(width - 12, middle + 4, f"{imports} · {imported}", 'text-anchor="end"'),
        ]
    return "\n".join([*parts, "</svg>", ""])


def _lines(house: House, at: dict[str, int], left: int) -> list[str]:
    """Each room's line to the right, each room's line from above with its arrow, and the dots."""
    parts = []
    down = sorted((at[a], at[b]) for a, b in house.arrows if at[a] < at[b])
    for row in range(len(at)):
        middle, right = TOP + row * ROW + ROW // 2, left + row * COLUMN
        targets = [b for a, b in down if a == row]
        sources = [a for a, b in down if b == row]
        if targets:
            end = left + max(targets) * COLUMN - COLUMN // 2
            parts.append(_path(f"M{right} {middle}H{end}", LINE))
        if sources:
            x, top = right - COLUMN // 2, middle - HEIGHT // 2
            start = TOP + min(sources) * ROW + ROW // 2
            parts.append(_path(f"M{x} {start}V{top - 5}", LINE))
            parts.append(f'<path d="M{x - 4} {top - 7}h8l-4 7z" fill="{LINE}"/>')
    for a, b in down:
        x, y = left + b * COLUMN - COLUMN // 2, TOP + a * ROW + ROW // 2
        parts.append(f'<circle cx="{x}" cy="{y}" r="3.5" fill="{INK}"/>')
    for a, b in sorted((at[a], at[b]) for a, b in house.arrows if at[a] > at[b]):
        x, y = left + b * COLUMN - BOX + 12, TOP + a * ROW + ROW // 2
        bottom = TOP + b * ROW + ROW // 2 + HEIGHT // 2
        parts.append(_path(f"M{left + a * COLUMN - BOX} {y}H{x}V{bottom + 5}", WRONG))
        parts.append(f'<path d="M{x - 4} {bottom + 7}h8l-4 -7z" fill="{WRONG}"/>')
    return parts


def _sentence_lines(sentence: str, width: int, middle: int) -> list[str]:
    """The sentence in a line or two to the left of its room."""
    lines = textwrap.wrap(sentence, int(width / LETTER))
    first = middle + 4 - 6 * (len(lines) - 1)
    return [
        _text(MARGIN, first + 12 * number, line, 'font-size="11"')
        for number, line in enumerate(lines)
    ]


def _path(d: str, colour: str) -> str:
    return f'<path d="{d}" fill="none" stroke="{colour}" stroke-width="1.2"/>'


def _text(x: int, y: int, text: str, more: str = "") -> str:
    return f'<text x="{x}" y="{y}" fill="{INK}" {more}>{escape(text)}</text>'


def main(arguments: list[str]) -> int:
    """Write the picture, or with --check compare it; the exit code."""
    if arguments not in ([], ["--check"]):
        print("usage: python tools/house.py [--check]", file=sys.stderr)
        return 2
    picture = draw(survey(REPOSITORY))
    if not arguments:
        PICTURE.write_text(picture)
        return 0
    if not PICTURE.exists() or PICTURE.read_text() != picture:
        print("docs/house.svg is not of today's imports: run `make picture`", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
