"""The pictures of docs/papers.md, from the studies: `python -m tools.figures [NAME ...]`.

With fewer runs than the studies make by themselves: a picture shows which is better, the tables of
the documentation have the figures. Up to some minutes of processor time each.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

from fusiond.studies import STUDIES

FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
RUNS = {
    "rdss-static": 60,
    "rdss-map": 200,
}


def main(names: list[str]) -> None:
    FIGURES.mkdir(exist_ok=True)
    for name in names or list(RUNS):
        study = import_module(STUDIES[name])
        study.plot(study.run(RUNS[name]), FIGURES / f"{name}.png")
        print(FIGURES / f"{name}.png")


if __name__ == "__main__":
    main(sys.argv[1:])
