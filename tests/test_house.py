"""The picture of the house, and the names that CONTRIBUTING and the architecture use."""

from __future__ import annotations

import ast
import re
import subprocess
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from tests.places import REPOSITORY
from tools.house import PICTURE, House, Room, draw, floors, main, survey

CONTRIBUTING = "".join(
    (REPOSITORY / name).read_text() for name in ("CONTRIBUTING.md", "docs/architecture.md")
)
SVG = "{http://www.w3.org/2000/svg}"
HOUSE = House(
    (
        Room("fusiond", 0, "The roof"),
        Room("fusiond.attic", 1, "What <is> under & over"),
        Room("fusiond.hall", 2, ""),
        Room("drivers", 3, "The cellar"),
    ),
    frozenset({("fusiond", "fusiond.attic"), ("fusiond.attic", "drivers"), ("fusiond", "drivers")}),
)


def drawn(house: House) -> ET.Element:
    return ET.fromstring(draw(house))


def texts(picture: ET.Element) -> list[str]:
    return [element.text or "" for element in picture.iter(f"{SVG}text")]


def test_every_room_and_every_arrow_is_drawn() -> None:
    picture = drawn(HOUSE)
    said = texts(picture)
    assert {"attic", "hall", "drivers", "What <is> under & over"} <= set(said)
    assert "4 rooms, 4 floors, 3 arrows, all of them down" in said[1]
    assert len(list(picture.iter(f"{SVG}circle"))) == 3
    assert said[-1] == "0 · 2"


def test_an_arrow_that_runs_up_is_told() -> None:
    wrong = House(HOUSE.rooms, HOUSE.arrows | {("drivers", "fusiond.hall")})
    assert "4 arrows, 1 of them up" in texts(drawn(wrong))[1]
    assert 'stroke="#c62828"' in draw(wrong)
    assert 'stroke="#c62828"' not in draw(HOUSE)


def test_the_order_of_arrows_does_not_show() -> None:
    assert draw(HOUSE) == draw(House(HOUSE.rooms, frozenset(sorted(HOUSE.arrows, reverse=True))))


def test_floors_are_those_of_the_contract(tmp_path: Path) -> None:
    pyproject = tmp_path / "pyproject.toml"
    pyproject.write_text(
        '[[tool.importlinter.contracts]]\nid = "other"\n'
        '[[tool.importlinter.contracts]]\nid = "floors"\nlayers = ["a", "b | (c)", "(d)"]\n'
    )
    assert floors(pyproject) == [["a"], ["b", "c"], ["d"]]


def test_no_room_of_the_daemon_is_left_out_of_its_contract() -> None:
    """`recording` was: a simulated vehicle could be imported there, and nobody told."""
    levels = floors(REPOSITORY / "pyproject.toml")
    above = [room for level in levels[: levels.index(["simulation"])] for room in level]
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    (held,) = (
        contract["source_modules"]
        for contract in project["tool"]["importlinter"]["contracts"]
        if contract["id"] == "daemon"
    )
    free = {"__main__", "batch", "bench", "commands", "demo", "studies"}
    assert {f"fusiond.{room}" for room in above if room not in free} == set(held)


def test_the_house_is_that_of_the_sources() -> None:
    house = survey(REPOSITORY)
    packages = {f"fusiond.{path.parent.name}" for path in REPOSITORY.glob("fusiond/*/__init__.py")}
    assert {room.name for room in house.rooms} == {"fusiond", "drivers", *packages}
    assert all(room.sentence for room in house.rooms)
    assert ("fusiond.live", "fusiond.navigator") in house.arrows
    assert ("fusiond.gnss", "drivers") in house.arrows
    assert not {(a, b) for a, b in house.arrows if a == "drivers"}


def test_an_old_picture_is_found_and_renewed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "house.svg"
    monkeypatch.setattr("tools.house.PICTURE", picture)
    assert main(["--check"]) == 1
    picture.write_text(PICTURE.read_text().replace("arrows", "errors"))
    assert main(["--check"]) == 1
    assert "make picture" in capsys.readouterr().err
    assert main([]) == 0
    assert main(["--check"]) == 0


def sources_of(module: str) -> list[Path]:
    """The file of a module, or all files of a package."""
    path = REPOSITORY.joinpath(*module.split("."))
    file = path.with_suffix(".py")
    return [file] if file.exists() else sorted(path.glob("**/*.py"))


def test_names_in_contributing_exist() -> None:
    modules = set(re.findall(r"`((?:fusiond|drivers)\.[\w.]+)`", CONTRIBUTING))
    modules.remove("fusiond.drivers")  # the group of entry points
    assert len(modules) > 25
    assert [module for module in modules if not sources_of(module)] == []
    paths = set(
        re.findall(r"[`(]((?:fusiond|drivers|tests|tools|docs)/[\w/.-]*)[`)]", CONTRIBUTING)
    )
    assert len(paths) > 8
    assert [path for path in paths if not (REPOSITORY / path).exists()] == []


def test_names_after_a_module_are_defined_in_it() -> None:
    """On the two ways through the house: "`drivers.can.bus` (`CanBus`)"."""
    pairs = re.findall(r"`((?:fusiond|drivers)\.[\w.]+)`\s\(`([\w.]+)`\)", CONTRIBUTING)
    assert len(pairs) > 20
    for module, name in pairs:
        source = "".join(path.read_text() for path in sources_of(module))
        for part in name.split("."):
            definition = rf"^\s*(?:async def|def|class) {part}\b"
            assert re.search(definition, source, re.MULTILINE), f"{module} has no {name}"


def test_every_room_says_what_it_must_not_do() -> None:
    rows = {
        name
        for line in CONTRIBUTING.splitlines()
        if line.startswith("| `")
        for name in re.findall(r"`([\w]+)/`", line.split("|")[1])
    }
    packages = {path.parent.name for path in REPOSITORY.glob("fusiond/*/__init__.py")}
    assert packages | {"drivers"} <= rows


def test_every_room_has_its_tests() -> None:
    rooms = {path.parent.name for path in REPOSITORY.glob("fusiond/*/__init__.py")} | {"drivers"}
    tested = {
        path.relative_to(REPOSITORY).parts[1] for path in REPOSITORY.glob("tests/**/test_*.py")
    }
    assert rooms - tested == set()


def test_files_that_are_named_exist() -> None:
    """In sources, configurations and pages: those that have moved keep no old name."""
    kept = subprocess.run(
        ("git", "ls-files"), cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    named = re.compile(
        r"(?<![\w/.])(?:fusiond|drivers|tests|tools|docs|config|benchmarks|systemd)/[\w/.-]*"
        r"\.(?:py|md|toml|dbc|sh|service|rules|network|json|csv|svg|png)\b"
    )
    ours = [name for name in kept.stdout.split() if name.endswith((".py", ".md", ".toml", ".yml"))]
    missing = {
        f"{name}: {path}"
        for name in ours
        for path in named.findall((REPOSITORY / name).read_text())
        if not (REPOSITORY / path).exists()
    }
    # In a wheel `drivers/config` is the folder `config`.
    assert {text for text in missing if ": drivers/config/" not in text} == set()


NOT_IN_THE_PROGRAM = {
    "fusiond.navigation.error_model.dense_transition": "what the kernels never form",
    "fusiond.simulation.can.star_tracker_radar.SIM_BAROMETER": "a device for who simulates one",
    "fusiond.studies.observability.gramian_stable": "an equation of paper 002",
}
"""Module-level names that tests alone use, and why they are there."""


def test_module_level_names_are_used() -> None:
    """By the program, an entry point or a decorator: what tests alone use is named above."""
    sources = {
        ".".join(path.relative_to(REPOSITORY).with_suffix("").parts).removesuffix(".__init__"): (
            ast.parse(path.read_text())
        )
        for room in ("fusiond", "drivers")
        for path in (REPOSITORY / room).rglob("*.py")
    }
    used = set(re.findall(r'= "([\w.]+:\w+)"', (REPOSITORY / "pyproject.toml").read_text()))
    used = {name.replace(":", ".") for name in used}
    for module, tree in sources.items():
        used |= _used(module, tree)
    unused = {
        name
        for module, tree in sources.items()
        for name in _defined(module, tree)
        if not {name, name.rpartition(".")[2]} & used
    }
    assert unused == set(NOT_IN_THE_PROGRAM)


def _defined(module: str, tree: ast.Module) -> list[str]:
    """Functions and classes without decorators, and constants."""
    found = []
    for node in tree.body:
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                found += [] if node.decorator_list else [node.name]
            case ast.Assign():
                found += [target.id for target in node.targets if isinstance(target, ast.Name)]
            case ast.AnnAssign(target=ast.Name(id=name)):
                found.append(name)
    return [f"{module}.{name}" for name in found if not name.startswith("__")]


def _used(module: str, tree: ast.Module) -> set[str]:
    """What a module takes of others and of itself, beside the definition."""
    used: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            used |= {f"{node.module}.{alias.name}" for alias in node.names}
    for top in tree.body:
        own = {getattr(top, "name", "")}
        if isinstance(top, ast.Assign | ast.AnnAssign):
            targets = top.targets if isinstance(top, ast.Assign) else [top.target]
            own = {target.id for target in targets if isinstance(target, ast.Name)}
        for node in ast.walk(top):
            match node:
                case ast.Name(id=name) if name not in own:
                    used.add(f"{module}.{name}")
                case ast.Attribute(attr=attribute):
                    used.add(attribute)  # of a module, maybe: `study.run`
    return used
