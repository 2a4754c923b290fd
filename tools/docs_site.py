"""The documentation as a site, in build/site, and whether every link of it leads somewhere.

    python -m tools.docs_site

`make docs` does it. mkdocs refuses what is wrong in the sources (`strict`); here the pages that
came of them are looked at as a browser does: what they load is theirs, so that no page asks
anything of another host, and every link inside leads to a page and a heading that are there. Links
to other sites are for people to follow and are not tried.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

REPOSITORY = Path(__file__).resolve().parents[1]
SITE = REPOSITORY / "build" / "site"
CSS_URL = re.compile(r"""url\(\s*["']?([^"')]+)|@import\s+["']([^"']+)""")
# What a browser loads by itself, by element; `link` does so for each rel that a page of ours has.
LOADS = {
    **dict.fromkeys(("script", "img", "iframe", "source", "video", "audio", "embed"), "src"),
    "link": "href",
    "object": "data",
}


class Page(HTMLParser):
    """What a page loads, where it links to, and where it can be linked to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.places: set[str] = set()
        self._style = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value is not None}
        self.places |= {given[name] for name in ("id", "name") if name in given}
        self._style = tag == "style"
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        elif tag in LOADS and LOADS[tag] in given:
            self.loads.append(given[LOADS[tag]])
        self.loads += _in_css(given.get("style", ""))

    def handle_data(self, data: str) -> None:
        if self._style:
            self.loads += _in_css(data)

    def handle_endtag(self, tag: str) -> None:
        self._style = False


def _in_css(text: str) -> list[str]:
    return [first or second for first, second in CSS_URL.findall(text)]


def mistakes(site: Path) -> Iterator[str]:
    """One line for each thing that is loaded from elsewhere or leads nowhere."""
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    for path, page in pages.items():
        at = path.relative_to(site)
        for url in page.loads:
            yield from _loaded(at, site, path, url)
        for url in page.links:
            parts = urlsplit(url)
            if parts.scheme or parts.netloc:
                continue
            target = _file(site, path, parts.path)
            if not target.exists():
                yield f"{at}: {url} leads nowhere"
            elif parts.fragment and unquote(parts.fragment) not in pages[target].places:
                yield f"{at}: {url}: there is no such heading"
    for path in sorted(site.rglob("*.css")):
        for url in _in_css(path.read_text(encoding="utf-8")):
            yield from _loaded(path.relative_to(site), site, path, url)


def _loaded(at: Path, site: Path, path: Path, url: str) -> Iterator[str]:
    parts = urlsplit(url)
    if parts.scheme == "data":
        return
    if parts.scheme or parts.netloc:
        yield f"{at}: {url} is loaded from another host"
    elif parts.path and not _file(site, path, parts.path).exists():
        yield f"{at}: {url} is not there"


def _file(site: Path, page: Path, url: str) -> Path:
    """The file behind a link of `page`."""
    if not url:
        return page
    base = site if url.startswith("/") else page.parent
    found = (base / unquote(url).lstrip("/")).resolve()
    return found / "index.html" if found.is_dir() else found


def main() -> int:
    """Build and check; the exit status."""
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"],
        cwd=REPOSITORY,
        check=False,
    )
    if built.returncode:
        return built.returncode
    found = list(mistakes(SITE))
    for line in found:
        print(line, file=sys.stderr)
    if not found:
        print(SITE / "index.html")
    return min(len(found), 1)


if __name__ == "__main__":
    sys.exit(main())
