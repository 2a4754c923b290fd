"""The pictures of docs/papers.md, from the studies: `python -m tools.figures [NAME ...]`.

With fewer runs than the studies make by themselves: a picture shows which is better, the tables of
the documentation have the figures. Up to some minutes of processor time each.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

from PIL import Image

from fusiond.studies import STUDIES

FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
RUNS = {
    "rdss-static": 60,
    "rdss-map": 200,
    "rdss-correlated": 3,
    "multiscale": 2,
    "federated": 2,
    "ukf": 2,
    "reduced-order": 2,
    "bds-tight": 2,
}
COLOURS = 64
"""Of a picture in the repository: curves need no more, and it has a third of the bytes."""


def main(names: list[str]) -> None:
    FIGURES.mkdir(exist_ok=True)
    for name in names or list(RUNS):
        study = import_module(STUDIES[name])
        path = FIGURES / f"{name}.png"
        study.plot(study.run_study(RUNS[name]), path)
        lightened(path)
        print(path)


def lightened(path: Path) -> None:
    """The same picture in fewer colours."""
    with Image.open(path) as image:
        image.convert("RGB").quantize(COLOURS).save(path, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1:])
