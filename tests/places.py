"""Where the tests find the repository and the recorded data."""

from __future__ import annotations

import os
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("FUSIOND_DATA", REPOSITORY.parent / "shared" / "data"))
"""Recorded drives and receiver logs; a test that needs one that is absent says which it skips."""
