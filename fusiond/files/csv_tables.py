"""Fast reader of numeric CSV tables with a header row, which names every implausible row.

`fusiond.files.csv_dialect` makes one dialect of several. A compiled reader reads plain decimals,
numpy's reader other numbers. Where both fail (an empty cell, a word, a truncated or blank line),
rows are read one by one, so that each rejection has its line and reason.

Reasons: `columns` (more or fewer cells than the header), `unreadable` (not a number), `missing`
(empty where the value must be known), `not_finite` (nan or inf), `out_of_range`,
`sd_not_positive`, `time_backwards`, `time_repeated`, `time_ahead` (a stamp later than those of the
rows that follow it), and those of a table's own rules. `sd_all_zero` rejects no row: a sigma that
is 0 in all of them is not given.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from io import BytesIO, TextIOWrapper
from math import inf, isfinite, nan
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.files.csv_dialect import DialectError, Text, first_line, plain_csv
from fusiond.files.fixed_decimal import newlines, parse_rows

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_TEXT_DTYPE = "U64"
_MAX_TIME_S = 9e9
"""Largest time (s) whose nanoseconds fit a 64-bit integer."""


class TableError(Exception):
    """Error: a file that cannot be read as its table; the text names file and reason."""


class MissingPackageError(Exception):
    """Error: a file format needs a package that is not installed; the text names it."""


@immutable()
class Rejection:
    """A rejected row: line in the file (the header is 1; 0: it has none), reason, value and count.

    Count 0: a note on the whole file."""

    line: int
    reason: str
    detail: str
    times: int = 1

    def __str__(self) -> str:
        where = f"line {self.line}: " if self.line else ""
        return f"{where}{self.reason}: {self.detail}"


@immutable()
class Column:
    """A numeric column: its header, whether it must be there and filled, and its allowed range.

    With `required` False the column may be absent and its cells empty; both read as NaN.
    A `positive` column (a standard deviation) must be above zero.
    """

    name: str
    required: bool = True
    low: float = -inf
    high: float = inf
    positive: bool = False


@immutable()
class Rule:
    """A condition between columns that no true row meets: `impossible(columns)` flags rows (n,)."""

    reason: str
    detail: str
    impossible: Callable[[dict[str, Floats]], Flags]


TIME = Column("t_s", low=-_MAX_TIME_S, high=_MAX_TIME_S)


@immutable()
class RawTable:
    """Plausible rows by column name (n,), and the rejected ones, in file order."""

    columns: dict[str, Floats]
    text: dict[str, list[str]]
    rejected: list[Rejection]


FEWEST_ZEROS = 10
"""Number of rows from which a sigma of 0 in all rows means that none was written; a single 0 is
implausible.
"""


def rejections_from_counts(refused: Mapping[str, int]) -> list[Rejection]:
    """Rejections of bytes, frames and sentences without line numbers, from counts by reason."""
    return [Rejection(0, name, f"{n} times", n) for name, n in refused.items() if n]


def rejection_counts(rejected: Iterable[Rejection]) -> dict[str, int]:
    """Number of rows rejected, by reason."""
    found = Counter[str]()
    for each in rejected:
        found[each.reason] += each.times
    return dict(+found)


def file_report(rows: int, rejected: Sequence[Rejection], first: int = 5) -> dict[str, Any]:
    """Summary of a file: rows used, rejected by reason, the first of them in words."""
    return {
        "rows": rows,
        "rejected": rejection_counts(rejected),
        "first_rejected": [str(rejection) for rejection in rejected[:first]],
    }


def read_table(
    path: Path | str,
    columns: Sequence[Column],
    rules: Sequence[Rule] = (),
    text: Sequence[str] = (),
) -> RawTable:
    """Read a table whose first column is time `t_s`, strictly increasing.

    Columns may stand in any order; those not named in `columns` or `text` are ignored. Raises
    `TableError` when the file cannot be opened, has no header, or lacks a required column.
    """
    path = Path(path)
    try:
        data = plain_csv(path)
        start = len(first_line(data)) + 1
        header = _header(data)
        _check_header(path, header, columns)
        rows = newlines(data) - 1 + (data[-1:].tobytes() != b"\n")
        parsed = None
        if rows and not text:
            parsed = _read_plain(data, start, rows, header)
        if rows and parsed is None:
            parsed = _read_clean(data, rows, header, text)
        if parsed is None:
            parsed = _read_with_care(data, header, columns, text)
    except DialectError as error:
        raise TableError(f"{path}: {error}") from error
    except OSError as error:
        raise TableError(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise TableError(f"{path}: not a text file ({error.reason})") from error
    values, words, lines, rejected = parsed

    n = len(lines)
    named = {c.name: values[c.name] if c.name in values else np.full(n, nan) for c in columns}
    keep = np.ones(n, dtype=np.bool_)
    rejected += _not_given(columns, named)
    for rule in _column_rules(columns):
        _apply(rule, named, lines, keep, rejected)
    for rule in rules:
        _apply(rule, named, lines, keep, rejected)
    _apply_time_order(named["t_s"], lines, keep, rejected)
    if not keep.all():
        named = {name: column[keep] for name, column in named.items()}
        chosen = np.flatnonzero(keep)
        words = {name: [cells[i] for i in chosen] for name, cells in words.items()}
    rejected.sort(key=lambda r: r.line)
    return RawTable(named, words, rejected)


# --------------------------------------------------------------------------- parsing

_Parsed = tuple[dict[str, Floats], dict[str, list[str]], NDArray[np.int64], list[Rejection]]


def _check_header(path: Path, header: list[str], columns: Sequence[Column]) -> None:
    if header == [""]:
        raise TableError(f"{path}: empty; a header row with column names is expected")
    twice = [name for name, n in Counter(header).items() if n > 1]
    if twice:
        raise TableError(f"{path}, line 1: column {twice[0]!r} occurs twice")
    lacking = [c.name for c in columns if c.required and c.name not in header]
    if lacking:
        raise TableError(f"{path}, line 1: lacks {', '.join(lacking)}; it has {', '.join(header)}")


def _as_text(data: Text) -> TextIO:
    """Decode as UTF-8; an invalid byte costs its cell only."""
    return TextIOWrapper(BytesIO(data.data), encoding="utf-8-sig", errors="replace")


def _header(data: Text) -> list[str]:
    """The cells of the first line. Raises `UnicodeDecodeError` where it is none of text."""
    line = first_line(data).partition(b"\r")[0]
    try:
        text = line.decode("utf-8-sig")
    except UnicodeDecodeError:
        if any(byte < ord(" ") for byte in line if byte != ord("\t")):
            raise
        text = line.decode("cp1252", "replace")  # a column more, named by a Windows in German
    return [cell.strip() for cell in text.split(",")]


def _read_plain(data: Text, start: int, rows: int, header: list[str]) -> _Parsed | None:
    """Parse a file of plain decimals, such as this project writes; None for any other."""
    values = np.empty((len(header), rows))
    if not parse_rows(data, start, values):
        return None
    lines = np.arange(2, rows + 2, dtype=np.int64)
    return dict(zip(header, values, strict=True)), {}, lines, []


def _read_clean(data: Text, rows: int, header: list[str], text: Sequence[str]) -> _Parsed | None:
    """Table by numpy's C reader; None if anything needs a closer look."""
    with _as_text(data) as stream:
        stream.readline()
        try:
            if text:
                dtype = np.dtype([(h, _TEXT_DTYPE if h in text else "f8") for h in header])
                table = np.loadtxt(stream, dtype, delimiter=",", comments=None, ndmin=1)
                values = {h: np.ascontiguousarray(table[h]) for h in header if h not in text}
                words = {h: [str(w) for w in table[h]] for h in header if h in text}
            else:
                matrix = np.loadtxt(stream, delimiter=",", comments=None, ndmin=2)
                if matrix.shape[1] != len(header):
                    return None
                values = dict(zip(header, np.ascontiguousarray(matrix.T), strict=True))
                words = {}
        except ValueError:
            return None
    if any(len(v) != rows or not np.isfinite(v).all() for v in values.values()):
        return None
    return values, words, np.arange(2, rows + 2, dtype=np.int64), []


def _number(cell: str) -> float:
    if "_" in cell:  # Python's float takes 1_000; no other reader does
        raise ValueError(cell)
    return float(cell)


def _read_with_care(
    data: Text, header: list[str], columns: Sequence[Column], text: Sequence[str]
) -> _Parsed:
    """Parse row by row: an unreadable cell rejects its row, an optional empty cell becomes NaN."""
    present = [(header.index(c.name), c) for c in columns if c.name in header]
    places = [(header.index(name), name) for name in text if name in header]
    rejected: list[Rejection] = []
    rows: list[list[float]] = []
    words: dict[str, list[str]] = {name: [] for _, name in places}
    lines: list[int] = []
    stream = _as_text(data)
    stream.readline()
    for line, row in enumerate(stream, start=2):
        cells = row.strip().split(",")
        if cells == [""]:
            continue
        fault = None
        numbers = []
        if len(cells) != len(header):
            fault = ("columns", f"{len(cells)} cells, the header has {len(header)}")
        else:
            for index, column in present:
                cell = cells[index].strip()
                if not cell:
                    if column.required:
                        fault = ("missing", f"{column.name} is empty")
                        break
                    numbers.append(nan)
                    continue
                try:
                    number = _number(cell)
                except ValueError:
                    fault = ("unreadable", f"{column.name} = {cell[:40]!r} is not a number")
                    break
                if not isfinite(number):
                    fault = ("not_finite", f"{column.name} = {cell[:40]}")
                    break
                numbers.append(number)
        if fault:
            rejected.append(Rejection(line, *fault))
            continue
        rows.append(numbers)
        lines.append(line)
        for index, name in places:
            words[name].append(cells[index].strip())
    matrix = np.array(rows, dtype=np.float64).reshape(len(rows), len(present))
    values = {c.name: matrix[:, k].copy() for k, (_, c) in enumerate(present)}
    return values, words, np.array(lines, dtype=np.int64), rejected


# --------------------------------------------------------------------------- validation


def _column_rules(columns: Sequence[Column]) -> list[Rule]:
    rules = []
    for c in columns:
        if c.positive:
            rules.append(Rule("sd_not_positive", f"{c.name} = {{{c.name}:g}}", _not_positive(c)))
        if isfinite(c.low) or isfinite(c.high):
            detail = f"{c.name} = {{{c.name}:.10g}}, allowed {c.low:g} to {c.high:g}"
            rules.append(Rule("out_of_range", detail, _outside(c)))
    return rules


def _not_given(columns: Sequence[Column], named: dict[str, Floats]) -> list[Rejection]:
    """Replace optional sigmas that are 0 in all rows by NaN: the writer had none. Returns a
    note."""
    zero = []
    for c in columns:
        values = named[c.name]
        given = values[~np.isnan(values)] if c.positive and not c.required else values[:0]
        if len(given) >= FEWEST_ZEROS and not given.any():
            zero.append(c.name)
            named[c.name] = np.full_like(values, nan)
    if not zero:
        return []
    names = f"{', '.join(zero)} {'are' if zero[1:] else 'is'} 0 in every row"
    return [Rejection(0, "sd_all_zero", f"{names}: taken as not given", 0)]


def _not_positive(c: Column) -> Callable[[dict[str, Floats]], Flags]:
    return lambda named: named[c.name] <= 0.0


def _outside(c: Column) -> Callable[[dict[str, Floats]], Flags]:
    return lambda named: (named[c.name] < c.low) | (named[c.name] > c.high)


def _apply(
    rule: Rule,
    named: dict[str, Floats],
    lines: NDArray[np.int64],
    keep: Flags,
    rejected: list[Rejection],
) -> None:
    """Remove the rows that a rule calls impossible from `keep`; the first reason stands."""
    for i in np.flatnonzero(rule.impossible(named) & keep):
        row = {name: float(column[i]) for name, column in named.items()}
        rejected.append(Rejection(int(lines[i]), rule.reason, rule.detail.format(**row)))
        keep[i] = False


def _apply_time_order(
    t: Floats, lines: NDArray[np.int64], keep: Flags, rejected: list[Rejection]
) -> None:
    """Keep the largest set of rows whose time strictly increases (the earlier rows on a tie).

    A single stamp far in the future thus costs its own row, not all that follow.
    """
    times = t if keep.all() else t[keep]
    if bool((times[1:] > times[:-1]).all()):
        return
    chosen = np.flatnonzero(keep)
    in_order = np.zeros(len(t), dtype=np.bool_)
    in_order[chosen[_longest_increasing(times)]] = True
    newest = -inf
    for i in chosen:
        if in_order[i]:
            newest = float(t[i])
            continue
        if t[i] == newest:
            reason = "time_repeated"
        elif t[i] < newest:
            reason = "time_backwards"
        else:
            reason = "time_ahead"
        rejected.append(Rejection(int(lines[i]), reason, f"t_s = {t[i]:.6f} after {newest:.6f}"))
    keep &= in_order


def _longest_increasing(times: Floats) -> list[int]:
    """Indices of a longest strictly increasing subsequence (patience sorting, from the end)."""
    tails: list[float] = []  # of decreasing sequences in reversed order, negated to ascend
    ends: list[int] = []
    follower = [-1] * len(times)
    for i in range(len(times) - 1, -1, -1):
        k = bisect_left(tails, -float(times[i]))
        if k == len(tails):
            tails.append(-float(times[i]))
            ends.append(i)
        else:
            tails[k] = -float(times[i])
            ends[k] = i
        follower[i] = ends[k - 1] if k else -1
    sequence = []
    i = ends[-1]
    while i >= 0:
        sequence.append(i)
        i = follower[i]
    return sequence
