"""The page that goes through the papers item by item: what it names is there, and its figures."""

from __future__ import annotations

import re

import numpy as np
from scipy.stats import chi2

from fusiond.estimators.federated.fusion import fuse_correlated, fuse_uncorrelated
from fusiond.studies import STUDIES
from fusiond.studies.federated import linear_experiments
from fusiond.studies.reduced_order import flight
from tests.places import REPOSITORY

PAGE = (REPOSITORY / "docs" / "papers-audit.md").read_text(encoding="utf-8")
ROWS = [line for line in PAGE.splitlines() if line.startswith("| ") and "`" in line]


def test_what_it_names_is_there() -> None:
    named = set(re.findall(r"`((?:fusiond|drivers|tests)/[\w/.]+\.py)`", PAGE))
    assert len(named) > 30
    assert [path for path in sorted(named) if not (REPOSITORY / path).is_file()] == []
    studies = set(re.findall(r"`study ([\w-]+)", PAGE))
    assert studies <= set(STUDIES)
    # A function or class beside its module.
    for path, name in re.findall(r"`((?:fusiond)/[\w/.]+\.py)` \(`(\w+)`\)", PAGE):
        assert name in (REPOSITORY / path).read_text(encoding="utf-8"), (path, name)


def test_every_paper_has_its_items_and_each_says_what_comes_out() -> None:
    for number in ("000", "001", "002", "003", "004"):
        part = PAGE.split(f"## {number}: ")[1].split("\n## ")[0]
        cells = [line.split(" | ") for line in part.splitlines() if line.startswith("| ")][2:]
        assert len(cells) >= 8, number
        assert all(len(row) == 4 and row[3].strip(" |") for row in cells), number


def test_the_interval_of_paper_000_is_chi_squares() -> None:
    low, high = chi2.ppf([0.025, 0.975], 100) / 100.0
    assert (round(low, 2), round(high, 1)) == (0.74, 1.3)
    assert f"[{low:.3f}, {high:.3f}]" in PAGE


def test_the_share_of_zeros_of_paper_002() -> None:
    """H of four satellites and the radar."""
    system = next(flight.systems(flight.model("ins23"), 2.0))
    zeros = 100.0 * float(np.mean(np.abs(system.h) < 1e-15))
    assert f"H {zeros:.0f} % zeros with four satellites" in PAGE, zeros


def test_experiments_1_and_2_of_paper_004() -> None:
    walk, constant = (
        linear_experiments.random_truth(50, 0),
        linear_experiments.constant_truth(50, 0),
    )
    said = f"{walk['filtered_rms_m']:.2f} m of {walk['measured_rms_m']:.2f} m measured"
    assert said in PAGE, said
    said = ", ".join(f"{x:.2f}" for x in constant["rms_m"])
    assert f"{said} m after 1, 10, 100" in PAGE, said


def test_both_fusions_are_the_papers_to_rounding() -> None:
    rng = np.random.default_rng(4)
    x, root = rng.standard_normal((2, 3)), rng.standard_normal((6, 6))
    joint = root @ root.T
    p_11, p_12, p_22 = joint[:3, :3], joint[:3, 3:], joint[3:, 3:]
    inverse = np.linalg.inv
    d = p_11 - p_12 - p_12.T + p_22
    fused, p = fuse_correlated(x[0], p_11, x[1], p_22, p_12)
    assert np.allclose(fused, x[0] + (p_11 - p_12) @ inverse(d) @ (x[1] - x[0]), atol=1e-12)
    assert np.allclose(p, p_11 - (p_11 - p_12) @ inverse(d) @ (p_11 - p_12).T, atol=1e-12)
    fused, p = fuse_uncorrelated(x, np.array([p_11, p_22]))
    assert np.allclose(p, inverse(inverse(p_11) + inverse(p_22)), atol=1e-12)
    assert np.allclose(fused, p @ (inverse(p_11) @ x[0] + inverse(p_22) @ x[1]), atol=1e-12)
