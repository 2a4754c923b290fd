"""Recovery of the readable messages of a damaged DBC file; the others are named.

One in six public files has a flaw: a 29-bit identifier without its mark (bit 31), a name that
begins with a digit, a comma for a decimal point, a comment without its signal, values of a message
that does not exist. Most flaws are not in the messages that one needs. For each message the
statements that decoding depends on are kept, and nothing else of the file:

    BO_, SG_              the message and its signals
    SIG_VALTYPE_          which of them are floating-point numbers
    SG_MUL_VAL_           which multiplexer's values select one
    BA_ of `_ATTRIBUTES`  SAE J1939 or not; names longer than 32 characters

An identifier that a standard frame cannot have is taken as an extended one. All messages are parsed
together; if that fails, each half by itself, and so on. A message whose multiplexer or types are
unreadable would be decoded wrongly and is left out; of any other message only the flawed signals
are left out.

Source: Vector Informatik, DBC File Format Documentation 1.0.5.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import cantools
from cantools.database.can import Database, Message

_ATTRIBUTES = ("VFrameFormat", "SystemMessageLongSymbol", "SystemSignalLongSymbol")
_STRING = r'"(?:\\"|[^"])*"'
_COMMENT = re.compile(rf"^[ \t]*CM_\s[^\";]*{_STRING}\s*;", re.MULTILINE)
_STATEMENT = re.compile(
    r"^[ \t]*(?:SIG_VALTYPE_|SG_MUL_VAL_|BA_DEF_DEF_|BA_DEF_|BA_)[ \t]+"
    rf"(?:{_STRING}|[^;\"\n]|\n(?!\s*[A-Z_]+_\s))*;?",
    re.MULTILINE,
)
"""Statement up to its semicolon; without one it ends before the next statement."""
_MESSAGE = re.compile(r"\s*BO_\s+(?P<id>\d+)\s+(?P<name>[^\s:]+)\s*:")
_SIGNAL = re.compile(r"\s*SG_\s+(?P<name>[^\s:]+)(?:\s+(?P<mux>[mM]\w*))?\s*:")
_OWNER = re.compile(r"\s*(?:SIG_VALTYPE_|SG_MUL_VAL_)\s+(\d+)\s+(\w+)")
_ATTRIBUTE = re.compile(rf"\s*BA_\w*\s+(?:(?:BO_|SG_)\s+)?\"({'|'.join(_ATTRIBUTES)})\"")
_ATTRIBUTE_OWNER = re.compile(r'\s*BA_\s+"\w+"\s+(BO_|SG_)\s+(\d+)(?:\s+(\w+))?')
UNSELECTED = "it shares its bits with other signals, and none (M) says which of them a frame holds"
LAST_STANDARD, LAST_EXTENDED, EXTENDED = 0x7FF, 0x1FFFFFFF, 1 << 31
_SIZES = re.compile(r"\bBO_\s+\d+\s+[^\s:]+\s*:\s*([-+]?\d+)|:\s*([-+]?\d+)\s*\|\s*([-+]?\d+)\s*@")
"""Sizes: bytes of a message, first bit and bits of a signal at any place: a signal may share its
message's line, and have a name of any length."""
MOST_BITS = 2048 * 8
"""Most bits: those of CAN XL, the longest frame. cantools allocates whatever a file states."""
_AT_LINE = re.compile(r"at line \d+, column \d+: ")


_END = '\nCM_ "";\n'
"""Appended end: the parser silently skips a truncated last statement, so none is the last."""


class UnreadableError(Exception):
    """Error of a file without a readable message; its text is the first reason."""


class SoundPart(Database):
    """Readable messages. `left_out` has the reasons for all others, by `Message` or
    `Message.Signal`; `extended` names those whose identifier was taken as one of 29 bits."""

    def __init__(
        self, messages: list[Message], left_out: dict[str, str], extended: list[str]
    ) -> None:
        super().__init__(messages, strict=False)
        self.left_out = left_out
        self.extended = extended


@dataclass(slots=True)
class _Unit:
    """Message with its statements."""

    name: str
    head: str
    signals: dict[str, str] = field(default_factory=dict)
    """Lines by name of the signal."""
    own: list[tuple[str | None, str]] = field(default_factory=list)
    """Statements, with the signal that each is of."""
    marked: bool = False
    """True if the extended-frame flag was added to its identifier."""

    def mark(self, can_id: str) -> None:
        """Add the extended-frame flag to an identifier beyond those of standard frames."""
        if not can_id.isascii() or not LAST_STANDARD < int(can_id) <= LAST_EXTENDED:
            return
        found, put = re.compile(rf"\b{can_id}\b"), str(int(can_id) | EXTENDED)
        self.head = found.sub(put, self.head, count=1)
        self.own = [(signal, found.sub(put, line, count=1)) for signal, line in self.own]
        self.marked = True

    def text(self, without: Iterable[str] = ()) -> tuple[str, str]:
        """Message without some signals, and the statements of the remaining ones."""
        left = set(self.signals) - set(without)
        lines = [line for name, line in self.signals.items() if name in left]
        own = [line for name, line in self.own if name is None or name in left]
        return "\n".join((self.head, *lines)), "\n".join(own)

    def without_attributes(self) -> _Unit:
        """The message without what no frame depends on, such as a format that no list has."""
        own = [(name, line) for name, line in self.own if not line.startswith("BA_")]
        return _Unit(self.name, self.head, self.signals, own, self.marked)

    @property
    def selectors(self) -> set[str]:
        """Multiplexer signals, which select others."""
        return {name for name, mark in self._marks() if mark.endswith("M")}

    def unselected(self) -> list[str]:
        """Signals that need a multiplexer which does not exist."""
        marks = self._marks()
        if any(mark.endswith("M") for _, mark in marks):
            return []
        return [name for name, mark in marks if len(mark) > 1]

    def _marks(self) -> list[tuple[str, str]]:
        """Suffix behind each name: M, m and a number, or nothing."""
        found = ((name, _SIGNAL.match(line)) for name, line in self.signals.items())
        return [(name, (m["mux"] or "") if m is not None else "") for name, m in found]


def read_whole(text: str) -> Database:
    """Parse a DBC file without flaws. Raises the parser's errors, and ValueError for a message or
    signal longer than any frame."""
    for size in _SIZES.finditer(text):
        numbers = [int(number) for number in size.groups() if number]
        if not 0 <= min(numbers) <= max(numbers) <= MOST_BITS:
            raise ValueError(f"no frame is so long: {size[0].strip(': @')!r}")
    found = cantools.database.load_string(text + _END, database_format="dbc", strict=False)
    assert isinstance(found, Database)
    return found


def sound_part(text: str) -> SoundPart:
    """Readable messages of a DBC file. Raises `UnreadableError`."""
    left_out: dict[str, str] = {}
    units, shared = _units(text, left_out)
    for unit in units:
        for name in unit.unselected():
            del unit.signals[name]
            left_out[f"{unit.name}.{name}"] = UNSELECTED
    reader = _Reader(_readable(shared, left_out), left_out)
    messages = reader.read(units)
    if not messages:
        raise UnreadableError(next(iter(left_out.values()), "there is no message in it"))
    read = {message.name for message in messages}
    return SoundPart(messages, left_out, [u.name for u in units if u.marked and u.name in read])


def unselected(text: str) -> bool:
    """True if a signal of the file shares bits with others, without a multiplexer for any.

    cantools would read such a signal in every frame.
    """
    units, _ = _units(text, {})
    return any(unit.unselected() for unit in units)


def _readable(shared: Sequence[str], left_out: dict[str, str]) -> list[str]:
    """Readable subset of the definitions common to all messages."""
    kept: list[str] = []
    for statement in shared:
        found = _read([*kept, statement])
        if isinstance(found, str):
            left_out[statement] = found
        else:
            kept.append(statement)
    return kept


class _Reader:
    """Reader of a DBC file's units; unreadable ones are noted in `left_out`."""

    def __init__(self, shared: Sequence[str], left_out: dict[str, str]) -> None:
        self._shared = shared
        self._left_out = left_out

    def read(self, units: Sequence[_Unit]) -> list[Message]:
        """Messages of the units; flawed ones are found by bisection."""
        if not units:
            return []
        found = self._together([unit.text() for unit in units])
        if not isinstance(found, str):
            return found
        if len(units) == 1:
            return self._partly(units[0], found)
        middle = len(units) // 2
        return [*self.read(units[:middle]), *self.read(units[middle:])]

    def _together(self, texts: Sequence[tuple[str, str]]) -> list[Message] | str:
        heads, own = zip(*texts, strict=True)
        return _read([*heads, *self._shared, *own])

    def _partly(self, unit: _Unit, reason: str) -> list[Message]:
        """Message without its unreadable attributes or signals; empty if other signals depend on
        one of them."""
        plain = unit.without_attributes()
        if not isinstance(found := self._together([plain.text()]), str):
            self._left_out[f"an attribute of {unit.name}"] = reason
            return found
        bad: dict[str, str] = {}
        selectors = unit.selectors
        for name in unit.signals:
            found = self._together([unit.text(unit.signals.keys() - {name} - selectors)])
            if isinstance(found, str):
                bad[name] = found
        if not bad or bad.keys() >= unit.signals.keys() or bad.keys() & selectors:
            self._left_out[unit.name] = reason
            return []
        rest = self._together([unit.text(bad)])
        if isinstance(rest, str):
            self._left_out[unit.name] = reason
            return []
        self._left_out |= {f"{unit.name}.{name}": why for name, why in bad.items()}
        return rest


def _read(parts: Iterable[str]) -> list[Message] | str:
    """Messages of a file with these parts, or the reason of failure."""
    try:
        database = read_whole("\n".join(('VERSION ""', *(part for part in parts if part))))
    except Exception as error:  # the parser also lets KeyError and bitstruct.Error through
        said = _AT_LINE.sub("", str(error)).removeprefix("DBC: ").strip('"')
        return " ".join(said.split()) or type(error).__name__
    return list(database.messages)


def _units(text: str, left_out: dict[str, str]) -> tuple[list[_Unit], list[str]]:
    """Split the file into messages with their statements, and the definitions that all share."""
    text = _COMMENT.sub("", text)
    own: dict[str, list[tuple[str | None, str]]] = defaultdict(list)
    shared: list[str] = []
    for match in _STATEMENT.finditer(text):
        statement = match[0].strip()
        if (owner := _OWNER.match(statement)) is not None:
            own[owner[1]].append((owner[2], statement))
        elif _ATTRIBUTE.match(statement) is None:
            continue
        elif (owner := _ATTRIBUTE_OWNER.match(statement)) is not None:
            own[owner[2]].append((owner[3] if owner[1] == "SG_" else None, statement))
        else:
            shared.append(statement)
    units: list[_Unit] = []
    unit: _Unit | None = None
    for line in text.splitlines():
        words = line.split(None, 2)
        if words[:1] == ["BO_"]:
            unit = None
            message = _MESSAGE.match(line)
            if message is None:
                name = words[2].partition(":")[0].strip() if len(words) > 2 else line.strip()
                left_out[name] = f"no message: {line.strip()!r}"
                continue
            unit = _Unit(message["name"], line.strip(), own=own[message["id"]])
            unit.mark(message["id"])
            units.append(unit)
        elif words[:1] == ["SG_"] and unit is not None:
            signal = _SIGNAL.match(line)
            unit.signals[signal["name"] if signal else line.strip()] = line.strip()
        elif words and not line.lstrip().startswith("//"):
            unit = None
    return units, shared
