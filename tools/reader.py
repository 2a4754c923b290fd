"""Reader's test: what a stranger stumbles over in the code, counted against budgets that only fall.

| count | what is counted |
|---|---|
| `questions` | docstrings that open with what, whether, how, who, when, where, which, why |
| `long_openings` | docstrings whose first sentence has more than 25 words |
| `long_functions` | functions of more than 60 lines, docstring included |
| `many_parameters` | functions of more than 10 parameters |
| `shared_names` | functions and methods whose name more than 25 others have |
| `private_words` | names with a word of the glossary's table "Words that go" |

Usage: python -m tools.reader [--list COUNT | --names | --check | --lower]. Without an option: the
table. `--check` fails where a count is above its budget; `--lower` writes the counts of today where
they are below; `--names` prints rooms, modules and public names, as for a test of names.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

REPOSITORY = Path(__file__).resolve().parents[1]
BUDGETS = REPOSITORY / "tools" / "reader.toml"
GLOSSARY = REPOSITORY / "docs" / "glossary.md"
PACKAGES = ("fusiond", "drivers")

QUESTIONS = frozenset(["what", "whether", "how", "who", "when", "where", "which", "whose", "why"])
MOST_WORDS, MOST_LINES, MOST_PARAMETERS, MOST_ALIKE = 25, 60, 10, 25
KINDS = (
    *("questions", "long_openings", "long_functions", "many_parameters"),
    *("shared_names", "private_words"),
)
Function = ast.FunctionDef | ast.AsyncFunctionDef


class Place(NamedTuple):
    """One thing that is counted, and where it stands."""

    kind: str
    path: Path
    line: int
    what: str


def private_words(glossary: str) -> frozenset[str]:
    """First column of the glossary's table of words that go."""
    table = glossary.split("## Words that go", 1)[1]
    rows = re.findall(r"^\| ([a-z, ]+) \|", table, flags=re.MULTILINE)
    return frozenset(word for row in rows for word in row.split(", ")) - {"our word"}


def survey(root: Path) -> list[Place]:
    """Every place in the packages below `root`, file by file."""
    words = private_words(GLOSSARY.read_text(encoding="utf-8"))
    found: list[Place] = []
    functions: list[tuple[Path, Function]] = []
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            tree, place = ast.parse(text), path.relative_to(root)
            found += _openings(place, tree)
            own = [
                n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)
            ]
            functions += [(place, n) for n in own]
            found += _shapes(place, own)
            found += _words(place, text, words)
    return found + list(_alike(functions))


def _openings(path: Path, tree: ast.Module) -> Iterator[Place]:
    for text, line in docstrings(tree):
        words = text.split()
        if words and words[0].strip("`,.:;").lower().removesuffix("'s") in QUESTIONS:
            yield Place("questions", path, line, text.partition("\n")[0])
        sentence = re.split(r"[.:;](?:\s|$)", text, maxsplit=1)[0]
        if len(sentence.split()) > MOST_WORDS:
            yield Place("long_openings", path, line, " ".join(sentence.split())[:90])


def docstrings(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Docstrings of modules, classes, functions and attributes, with their lines."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                value = statement.value.value
                if isinstance(value, str):
                    yield value.strip(), statement.lineno


def _shapes(path: Path, functions: list[Function]) -> Iterator[Place]:
    for node in functions:
        lines = (node.end_lineno or node.lineno) - node.lineno + 1
        if lines > MOST_LINES:
            yield Place("long_functions", path, node.lineno, f"{node.name}: {lines} lines")
        count = sum(len(a) for a in (node.args.posonlyargs, node.args.args, node.args.kwonlyargs))
        if count > MOST_PARAMETERS:
            yield Place("many_parameters", path, node.lineno, f"{node.name}: {count} parameters")


def _alike(functions: list[tuple[Path, Function]]) -> Iterator[Place]:
    count = Counter(node.name for _, node in functions)
    for path, node in functions:
        name = node.name
        if count[name] > MOST_ALIKE and not name.startswith("__"):
            yield Place("shared_names", path, node.lineno, f"{name}: one of {count[name]}")


def _words(path: Path, text: str, private: frozenset[str]) -> Iterator[Place]:
    seen: set[str] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type != tokenize.NAME or token.string in seen:
            continue
        seen.add(token.string)
        parts = re.split(r"_|(?<=[a-z])(?=[A-Z])", token.string)
        for word in {part.lower() for part in parts} & private:
            yield Place("private_words", path, token.start[0], f"{token.string} ({word})")
    for word in set(path.stem.split("_")) & private:
        yield Place("private_words", path, 1, f"{path.stem}.py ({word})")


def names(root: Path) -> Iterator[str]:
    """Modules room by room, each with its public names."""
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
            public = [n.name for n in tree.body if isinstance(n, kinds) and n.name[0] != "_"]
            if public:
                yield f"{path.relative_to(root)}: {', '.join(public)}"


def over(counts: Counter[str], budgets: dict[str, int]) -> list[str]:
    """A line for each count above its budget."""
    return [
        f"{kind}: {counts[kind]}, budget {budgets[kind]}: see python -m tools.reader --list {kind}"
        for kind in KINDS
        if counts[kind] > budgets[kind]
    ]


def lowered(counts: Counter[str], budgets: dict[str, int]) -> str:
    """The file of budgets with those that may fall."""
    lines = [f"{kind} = {min(counts[kind], budgets[kind])}" for kind in KINDS]
    return "\n".join(["# Budgets of tools/reader.py: they only fall (--lower).", *lines, ""])


def main(arguments: list[str]) -> int:
    """Run the command line; the exit code."""
    match arguments:
        case ["--names"]:
            print("\n".join(names(REPOSITORY)))
            return 0
        case [] | ["--check"] | ["--lower"] | ["--list", _]:
            pass
        case _:
            print("usage: python -m tools.reader [--list COUNT|--names|--check|--lower]")
            return 2
    found = survey(REPOSITORY)
    counts, budgets = Counter(p.kind for p in found), tomllib.loads(BUDGETS.read_text())
    match arguments:
        case ["--list", kind]:
            for place in (p for p in found if p.kind == kind):
                print(f"{place.path}:{place.line}: {place.what}")
        case ["--lower"]:
            BUDGETS.write_text(lowered(counts, budgets))
        case ["--check"]:
            lines = over(counts, budgets)
            print("\n".join(lines), file=sys.stderr, end="\n" * bool(lines))
            return 1 if lines else 0
        case _:
            for kind in KINDS:
                print(f"{kind:16} {counts[kind]:6} of {budgets[kind]}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
