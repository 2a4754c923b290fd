"""The map below the track in a real browser: images and shapes, by day and by night.

    python -m benchmarks.map_check [--shots DIR]

A file of one colour lies below a vehicle of the examples; what the canvas shows beside the vehicle
is held against it. Prints a line a question, exits 1 where an answer is no.
"""

from __future__ import annotations

import argparse
import asyncio
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from playwright.async_api import Browser, async_playwright

from fusiond.dashboard.vehicles import Hub
from tests.dashboard.serving import at_work, payload, said
from tests.dashboard.tiles import MVT, PNG, all_water, png, tile_of, write_map

CHROMIUM = ["--no-sandbox", "--disable-background-networking", "--disable-component-update"]
ZOOMS = range(10, 19)
IMAGE = (200, 120, 40)
WATER = {"light": (188, 217, 234), "dark": (23, 50, 74)}
"""`--water` of the page's style."""
PIXEL = """() => { const c = document.getElementById("map");
  return [...c.getContext("2d").getImageData(c.width * 0.3, c.height * 0.37, 1, 1).data]; }"""
NEAR = 3
"""Of 255: rounding in the browser's colours."""


async def shown(
    browser: Browser, folder: Path, name: str, tile: bytes | None, kind: int, scheme: Any
) -> tuple[list[int], list[str]]:
    """The colour beside the vehicle, and what went wrong in the page."""
    nav = said("nav")
    path = folder / f"{name}.pmtiles"
    at = [
        (zoom, x + dx, y + dy)
        for zoom in ZOOMS
        for x, y in [tile_of(nav["lat_deg"], nav["lon_deg"], zoom)]
        for dx in (-1, 0, 1)
        for dy in (-1, 0, 1)
    ]
    if tile is not None:
        write_map(path, tile, kind, at)
    clock = asyncio.get_running_loop().time
    hub = Hub(clock, "test")
    hub.linked("up")
    hub.receive("truck", "nav", payload("nav"))
    troubles: list[str] = []
    async with at_work(hub, base_map=path if tile is not None else None) as address:
        page = await browser.new_page(viewport={"width": 1600, "height": 1180}, color_scheme=scheme)
        page.on("console", lambda m: troubles.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: troubles.append(str(e)))
        page.on("request", lambda r: None if address in r.url else troubles.append(r.url))
        await page.goto(f"http://{address}/")
        colour: list[int] = []
        for _ in range(100):
            colour = await page.evaluate(PIXEL)
            if tile is not None and colour[3] == 255:
                break
            await asyncio.sleep(0.05)
        await page.locator("#map-card").screenshot(path=folder / f"{name}.png")
        await page.close()
    return colour, troubles


async def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shots", type=Path)
    arguments = parser.parse_args()
    chromium = shutil.which("chromium")
    if chromium is None:
        raise SystemExit("chromium is missing: apt-get install chromium")
    wrong = 0
    with tempfile.TemporaryDirectory() as made:
        folder = arguments.shots or Path(made)
        folder.mkdir(exist_ok=True)
        async with async_playwright() as playwright:
            browser = await playwright.chromium.launch(executable_path=chromium, args=CHROMIUM)
            for name, tile, kind, scheme, wanted in (
                ("no_map", None, PNG, "light", (0, 0, 0, 0)),
                ("images", png(*IMAGE), PNG, "light", (*IMAGE, 255)),
                ("shapes_by_day", all_water(), MVT, "light", (*WATER["light"], 255)),
                ("shapes_by_night", all_water(), MVT, "dark", (*WATER["dark"], 255)),
            ):
                colour, troubles = await shown(browser, folder, name, tile, kind, scheme)
                right = not troubles and all(
                    abs(a - b) <= NEAR for a, b in zip(colour, wanted, strict=True)
                )
                wrong += not right
                print(f"{'ok  ' if right else 'FAIL'} {name}: {colour} {troubles or ''}")
            await browser.close()
    return min(wrong, 1)


if __name__ == "__main__":
    sys.exit(asyncio.run(main()))
