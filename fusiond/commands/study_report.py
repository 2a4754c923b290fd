"""Printed result of a study: rich tables on a terminal, plain text in a pipe."""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType
from typing import Any

from rich.console import Console

from fusiond.commands.tables import print_table

Table = tuple[str, list[str], list[list[str]]]


def print_study(study: ModuleType, result: dict[str, Any], console: Console | None = None) -> None:
    """Print the result of a study to `console` or standard output: its own tables, or every list of
    records in the result, then its finding."""
    console = console or Console()
    if hasattr(study, "table"):
        console.print(study.table(result), highlight=False, markup=False, soft_wrap=True)
    else:
        tables = study.tables(result) if hasattr(study, "tables") else _records(result)
        for title, header, rows in tables:
            console.print(title, highlight=False, markup=False, soft_wrap=True)
            print_table(console, header, rows)
            console.print()
    if "finding" in result:
        console.print(result["finding"], highlight=False, markup=False, soft_wrap=True)


def _records(result: dict[str, Any]) -> Iterator[Table]:
    for name, value in result.items():
        if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
            rows = [dict(_flat(row)) for row in value]
            header = list(dict.fromkeys(key for row in rows for key in row))
            yield name.replace("_", " "), header, [[row.get(k, "") for k in header] for row in rows]


def _flat(record: dict[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    for key, value in record.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{key} ")
        elif isinstance(value, list):
            yield before + key, " ".join(_text(item) for item in value)
        else:
            yield before + key, _text(value)


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)
