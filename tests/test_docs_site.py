"""What is said of a site whose pages load from elsewhere or lead nowhere."""

from __future__ import annotations

import re
from pathlib import Path

from tests.places import REPOSITORY
from tools.docs_site import mistakes
from tools.figures import RUNS

GOOD = """<html><head><link rel="stylesheet" href="style.css"></head>
<body><h1 id="top">Top</h1><a href="other.html#deep">there</a> <a href="#top">up</a>
<a href="https://example.org/">outside, for people</a><img src="data:image/png;base64,AA"></body>"""
OTHER = '<h2 id="deep">Deep</h2><a href="index.html#nothing">x</a><a href="gone.html">y</a>'
LOADING = """<script src="https://cdn.example.org/a.js"></script><img src="gone.png">
<style>@import "//fonts.example.org/f.css";</style>
<p style="background: url(https://example.org/p.png)">p</p>"""


def test_broken_links_are_named(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text(GOOD)
    (tmp_path / "other.html").write_text('<h2 id="deep">Deep</h2>')
    (tmp_path / "style.css").write_text("p { background: url('style.css') }")
    assert list(mistakes(tmp_path)) == []
    (tmp_path / "other.html").write_text(OTHER)
    (tmp_path / "style.css").write_text("@font-face { src: url(https://example.org/f.woff) }")
    (tmp_path / "third.html").write_text(LOADING)
    assert list(mistakes(tmp_path)) == [
        "other.html: index.html#nothing: there is no such heading",
        "other.html: gone.html leads nowhere",
        "third.html: https://cdn.example.org/a.js is loaded from another host",
        "third.html: gone.png is not there",
        "third.html: //fonts.example.org/f.css is loaded from another host",
        "third.html: https://example.org/p.png is loaded from another host",
        "style.css: https://example.org/f.woff is loaded from another host",
    ]


def test_every_page_is_in_the_navigation_and_every_picture_is_drawn() -> None:
    listed = re.findall(r"([\w-]+\.md)$", (REPOSITORY / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted(path.name for path in (REPOSITORY / "docs").glob("*.md"))
    drawn = {path.stem for path in (REPOSITORY / "docs" / "figures").glob("*.png")}
    shown = set(re.findall(r"figures/([\w-]+)\.png", (REPOSITORY / "docs/papers.md").read_text()))
    assert drawn == shown == set(RUNS)


def test_every_page_opens_with_whom_it_is_for() -> None:
    """The first paragraph below the title; index.md is a table of that."""
    pages = [path for path in (REPOSITORY / "docs").glob("*.md") if path.name != "index.md"]
    second = {path.name: path.read_text(encoding="utf-8").split("\n\n")[1] for path in pages}
    assert [name for name, text in second.items() if not text.startswith("For ")] == []
