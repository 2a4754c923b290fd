"""On whose terms a vehicle has its packages: `python -m tools.licences` writes them down.

`LICENSE-third-party.md` names each locked package with its licence. It goes into the wheel and into
the Debian package, which has the packages themselves as well. Who adds a package on terms that
nobody has looked at, or whose text is not there, is told so here, by a test, and by the build.
"""

from __future__ import annotations

import re
import sys
import sysconfig
from importlib.metadata import Distribution, distributions
from pathlib import Path
from typing import NamedTuple

REPOSITORY = Path(__file__).resolve().parents[1]
FILE = REPOSITORY / "LICENSE-third-party.md"
BEGIN, END = "<!-- packages -->\n", "<!-- end of packages -->\n"
PERMISSIVE = frozenset(
    {"0BSD", "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "BSD-2-Clause", "BSD-3-Clause", "BSD"}
    | {"CC0-1.0", "ISC", "MIT", "MIT-0", "PSF-2.0", "Zlib"}
)
"""Terms that ask for their text and the authors' names. `BSD`: what a package calls itself that
does not say of how many clauses; its text does."""
LOOKED_AT = {"python-can": "LGPL-3.0-only", "paho-mqtt": "EPL-2.0 OR BSD-3-Clause"}
"""Other terms, and what is done for them stands in the file."""
_CALLED = {"MIT License": "MIT", "BSD License": "BSD", "ISC License (ISCL)": "ISC"}
_TEXT = re.compile(r"licen[cs]e|copying|notice", re.IGNORECASE)


class Package(NamedTuple):
    """A package that is installed: its terms, and whether their text came with it."""

    name: str
    version: str
    licence: str
    has_text: bool


def locked(lock: Path) -> set[str]:
    """Names in a file of requirements."""
    return set(re.findall(r"^([a-z0-9][a-z0-9._-]*)==", lock.read_text(encoding="utf-8"), re.M))


def packages(folder: Path, names: set[str] | None = None) -> list[Package]:
    """Those that are installed in a folder, of `names` or all but fusiond itself, by name."""
    found = {}
    for each in distributions(path=[str(folder)]):
        name = re.sub(r"[-_.]+", "-", each.metadata["Name"]).lower()
        if name != "fusiond" and (names is None or name in names):
            found[name] = Package(name, each.version, _licence(each), _has_text(each, folder))
    return [found[name] for name in sorted(found)]


def _licence(package: Distribution) -> str:
    """By the expression that it states, else its classifier, else its own words."""
    said = package.metadata
    if "License-Expression" in said:
        return str(said["License-Expression"])
    classifiers = [c for c in said.get_all("Classifier") or () if c.startswith("License ::")]
    called = classifiers[-1].rpartition(" :: ")[2] if classifiers else str(said.get("License", ""))
    return _CALLED.get(called, called)


def _has_text(package: Distribution, folder: Path) -> bool:
    """In its `.dist-info`, which an installation keeps."""
    stem = re.sub(r"[-_.]+", "[-_.]", re.escape(package.metadata["Name"]).replace("\\", ""))
    named = re.compile(rf"{stem}-{re.escape(package.version)}\.dist-info", re.IGNORECASE)
    infos = [path for path in folder.iterdir() if named.fullmatch(path.name)]
    return any(_TEXT.search(path.name) for info in infos for path in info.rglob("*"))


def faults(found: list[Package]) -> list[str]:
    """What keeps the packages from being given away: a sentence each."""
    ours = FILE.read_text(encoding="utf-8")
    sentences = []
    for package in found:
        terms = {part.strip() for part in re.split(r"\bAND\b|\bOR\b", package.licence)}
        if not terms <= PERMISSIVE and LOOKED_AT.get(package.name) != package.licence:
            sentences.append(f"{package.name}: nobody has looked at {package.licence!r}")
        if not package.has_text and f"## {package.name}\n" not in ours:
            sentences.append(f"{package.name}: the text of its licence is nowhere")
    return sentences


def table(found: list[Package]) -> str:
    rows = [
        f"| {p.name} | {p.licence} | {'its `.dist-info`' if p.has_text else 'below'} |"
        for p in found
    ]
    return "\n".join(("| package | licence | text |", "|---|---|---|", *rows, ""))


def text() -> str:
    """The file with the table of today."""
    names = locked(REPOSITORY / "requirements.lock")
    found = packages(Path(sysconfig.get_path("purelib")), names)
    if missing := names - {package.name for package in found}:
        sys.exit(f"not installed here: {', '.join(sorted(missing))}")
    head, _, rest = FILE.read_text(encoding="utf-8").partition(BEGIN)
    return head + BEGIN + "\n" + table(found) + "\n" + END + rest.partition(END)[2]


def main() -> int:
    FILE.write_text(text(), encoding="utf-8")
    names = locked(REPOSITORY / "requirements.lock")
    found = faults(packages(Path(sysconfig.get_path("purelib")), names))
    print("\n".join(found) or "every package has terms that were looked at, and their text")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
