"""Printed tables: rich on a terminal, aligned plain text in a pipe."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table


def print_table(console: Console, header: list[str], rows: list[list[str]]) -> None:
    """Rows of text under a header: a rich table on a terminal, aligned columns in a pipe."""
    if console.is_terminal:
        table = Table(*header)
        for row in rows:
            table.add_row(*row)
        console.print(table)
        return
    widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
    for row in [header, *rows]:
        first, *rest = (cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        console.print(
            "  ".join([first.strip().ljust(widths[0]), *rest]).rstrip(),
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
