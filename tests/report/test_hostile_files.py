"""Files that are no log, and texts in them that a browser would carry out."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from fusiond.report.report import report
from tests.report.pages import (
    fusiond,
    item,
    read_page,
    written,
)

ASSETS = Path(__file__).parents[2] / "fusiond" / "report" / "assets"
HOSTILE = '</script><script>alert(1)</script><img src=x onerror="alert(2)"><!--'


@pytest.mark.parametrize("content", [b"", b"t_s,lat\n" * 20, b"\x89MCAP0\r\n"])
def test_a_file_that_is_no_log_is_refused_in_one_line(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    code, text = fusiond(path, "--out", tmp_path / "x.html")
    assert code == 65
    assert text.startswith(f"fusiond: {path}: no ")
    assert text.count("\n") == 1
    assert not (tmp_path / "x.html").exists()


def test_values_of_the_wrong_kind_cost_themselves_alone(tmp_path: Path) -> None:
    good = {"mode": "navigating", "lat_deg": 30.5, "lon_deg": 114.3, "height_m": 40.0}
    messages = [
        ("/nav", 1.0, json.dumps(good).encode()),
        ("/nav", 1.1, json.dumps({**good, "lat_deg": "north", "v_n_m_s": True}).encode()),
        ("/nav", 1.2, b"[1, 2]"),
        ("/health", 1.3, b'{"sources": {"gnss": 3, "imu": {"rejected": [], "sky": 1}}}'),
        ("/consistency", 1.4, b'{"sources": {"gnss": {"rho": "x"}}}'),
        ("/calibration", 1.5, b'{"parameters": null}'),
        ("/innovation", 1.6, b'{"t_ns": "soon", "source": 1}'),
        ("/fusiond/state", 1.7, b'{"navigation": {"xi": [1], "covariance": [1, 2]}}'),
        ("/nav", 1.8, json.dumps(good).encode()),
    ]
    log = written(tmp_path / "odd.mcap", messages)
    (run,) = report([log], tmp_path / "odd.html")
    assert np.isfinite(run.solution.lat_rad).tolist() == [True, False, True]
    assert any("1 messages are no JSON objects" in p.text for p in run.problems)
    assert read_page(tmp_path / "odd.html")["sections"]


def test_names_and_texts_from_a_file_stay_text(tmp_path: Path) -> None:
    nav = json.dumps({"mode": HOSTILE, "lat_deg": 30.5, "lon_deg": 114.3, "height_m": 1.0}).encode()
    event = {"level": HOSTILE, "code": HOSTILE, "source": HOSTILE, "text": HOSTILE}
    health = {"sources": {HOSTILE: {"fused": 1, "rejected": {HOSTILE: 2}}}}
    messages = [
        ("/nav", 1.0, nav),
        ("/event", 1.1, json.dumps(event).encode()),
        ("/health", 1.2, json.dumps(health).encode()),
        ("/nav", 2.0, nav),
    ]
    named = tmp_path / "<img src=x onerror=alert(3)>.mcap"
    log = written(named, messages, metadata={"vehicle": HOSTILE})
    report([log], tmp_path / "hostile.html")
    text = (tmp_path / "hostile.html").read_text()
    assert "alert(1)" in text
    assert not re.findall("<script>alert|<img|<!--", text)
    document = read_page(tmp_path / "hostile.html")
    assert ["vehicle", HOSTILE] in item(document, "Summary", "Run")["rows"]
    assert document["runs"][0]["events"][0][1:] == [HOSTILE] * 4
    # ... and what the page's own scripts write is text too.
    own = "".join(p.read_text() for p in ASSETS.glob("*.js"))
    assert not re.findall(
        r"innerHTML|outerHTML|insertAdjacent|document\.write|eval\(|Function\(", own
    )
