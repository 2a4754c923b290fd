"""When the simulated devices start: half a minute before a midnight of UTC."""

from __future__ import annotations

from datetime import UTC, datetime

UTC_START_NS = int(datetime(2026, 11, 20, 23, 59, 30, tzinfo=UTC).timestamp()) * 10**9 + 123_456_789
