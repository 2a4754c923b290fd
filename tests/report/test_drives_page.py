"""A page of many drives: what stands in it, and that a browser draws and sorts it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.files.resumable_parquet import write_rows
from tests.patience import PATIENCE_S
from tests.report.pages import item, items, numbers, read_page, series

HOSTILE = "</script><script>alert(1)</script>"
CONFIGURATIONS = ("aaa", "bbb")


def row(number: int, config: str, rms_m: float) -> dict[str, Any]:
    return {
        "log": f"/drives/{number}.mcap",
        "config_digest": config,
        "version": "1",
        "ended": "done",
        "reason": "",
        "modes.navigating": 0.75,
        "modes.aligning": 0.25,
        "outcomes.gnss.fused": 90,
        "outcomes.gnss.gated": 10,
        "consistency.gnss": "consistent",
        "error.horizontal_rms_m": rms_m,
        "error.position_nees": 3.0 + rms_m,
    }


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two configurations of ten drives each, of the second twice as far off; two without."""
    folder = tmp_path_factory.mktemp("batch")
    rows = [
        row(number, config, (k + 1) * (1.0 + 0.1 * number))
        for k, config in enumerate(CONFIGURATIONS)
        for number in range(10)
    ]
    lost = {"config_digest": "aaa", "version": "1", "ended": "error", "reason": HOSTILE}
    rows += [{**lost, "log": f"/drives/{name}"} for name in ("x", "y")]
    write_rows(folder / "rows.parquet", rows)
    call = ["report", "--batch", str(folder / "rows.parquet"), "--out", str(folder / "page.html")]
    done = CliRunner().invoke(app, call)
    assert done.exit_code == 0, done.output
    return folder / "page.html"


def test_distributions_of_both_configurations_stand_beside_each_other(page: Path) -> None:
    document = read_page(page)
    spread = item(document, "Errors against the truth", "Over the drives")
    median = spread["head"].index("50 %")
    assert [(r[1], r[median]) for r in spread["rows"]] == [("aaa", "1.45"), ("bbb", "2.9")]
    plot = item(document, "Errors against the truth", "Horizontal error, RMS")
    x = numbers(plot["x"])
    assert x[0] == pytest.approx(1.0)
    assert x[-1] == pytest.approx(3.8)
    for name in CONFIGURATIONS:  # the last value closes the outline
        assert series(plot, name)[:-1].sum() == pytest.approx(1.0)
    nees = item(document, "Is sigma honest?", "Over the drives")
    assert nees["rows"][0][nees["head"].index("expected")] == "3"


def test_failures_have_reason_count_and_example(page: Path) -> None:
    document = read_page(page)
    assert document["runs"][0]["problems"] == [
        ["warning", "2 of 22 have no figures: 2 error."],
    ]
    assert item(document, "Failures", "Why")["rows"] == [["2", "error", HOSTILE, "x"]]
    assert HOSTILE not in page.read_text()


def test_outcomes_modes_and_verdicts_over_all_drives(page: Path) -> None:
    document = read_page(page)
    rows = item(document, "Outcomes", "What became")["rows"]
    assert ["aaa", "gnss", "fused", "900", "90.00 %", "10"] in rows
    assert item(document, "Modes", "Share")["rows"][1] == ["bbb", "75.00 %", "25.00 %"]
    assert item(document, "Verdicts", "Of each")["rows"][0] == ["aaa", "gnss", "10 consistent"]


def test_a_file_that_has_no_rows_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.parquet"
    write_rows(other, [{"t_s": 1.0}])
    call = ["report", "--out", str(tmp_path / "page.html")]
    done = CliRunner().invoke(app, [*call, "--batch", str(other)])
    assert done.exit_code == 65
    assert "no rows of fusiond batch" in done.stderr
    assert CliRunner().invoke(app, call).exit_code == 2
    assert CliRunner().invoke(app, [*call, "a.mcap", "--batch", str(other)]).exit_code == 2


@pytest.mark.skipif(shutil.which("chromium") is None, reason="Debian's chromium is not installed")
def test_a_browser_draws_sorts_and_searches(page: Path, tmp_path: Path) -> None:
    """Sorted by error, largest first; then only those whose name has a 7."""
    told = tmp_path / "told.html"
    watch = """<script>addEventListener('load', () => setTimeout(() => {
        const first = () => document.querySelector('.grid tbody td').textContent;
        const heads = [...document.querySelectorAll('.grid th button')];
        const wanted = heads.find((b) => b.textContent.startsWith('horizontal'));
        wanted.click(); wanted.click();
        const largest = first(), link = document.querySelector('.grid td a').href;
        const search = document.querySelector('input');
        search.value = '7.mcap'; search.oninput();
        const found = document.querySelectorAll('.grid tbody tr').length;
        document.title = [document.querySelectorAll('.uplot').length, largest, link, found];
    }, 0));</script>"""
    told.write_text(page.read_text().replace("</body>", watch + "</body>"))
    done = subprocess.run(
        [
            *("chromium", "--headless", "--no-sandbox", "--disable-gpu"),
            *("--disable-background-networking", "--disable-component-update"),
            *(f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=2000"),
            *("--dump-dom", told.as_uri()),
        ],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
    )
    document = read_page(page)
    plots = sum(
        i["kind"] == "plot" for s in document["sections"] for i in items(document, s["title"])
    )
    assert plots > 2
    assert f"<title>{plots},9.mcap,file:///drives/9.mcap,2</title>" in done.stdout
