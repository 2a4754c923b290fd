"""Fusion formulas and the kernels of a bank, against brute-force weighted least squares."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from fusiond.estimators.federated.fusion import fuse_correlated, fuse_uncorrelated, information
from fusiond.estimators.federated.fusion_kernels import (
    carry,
    cholesky,
    combine,
    difference,
    inverse_of_factor,
)

Array = NDArray[np.float64]
# Sigmas of an INS: attitude, velocity, position, gyro bias.
SCALES = np.array([1e-4, 1e-3, 0.05, 0.1, 3.0, 900.0, 1e-6])


def covariance(rng: np.random.Generator, n: int, scale: Array) -> Array:
    root = rng.standard_normal((n, n + 2)) * scale[:n, None]
    return np.asarray(root @ root.T)


def least_squares(y: list[Array], joint: Array) -> tuple[Array, Array]:
    """Estimate and covariance of x from stacked estimates with their joint covariance."""
    n = len(y[0])
    a = np.vstack([np.eye(n)] * len(y))
    weight = np.linalg.inv(joint)
    p = np.linalg.inv(a.T @ weight @ a)
    return p @ a.T @ weight @ np.concatenate(y), p


@pytest.mark.parametrize("seed", range(5))
def test_uncorrelated_estimates_fuse_as_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ones = np.ones(4)
    ps = np.array([covariance(rng, 4, ones * (1.0 + i)) for i in range(3)])
    xs = rng.standard_normal((3, 4))
    joint = np.zeros((12, 12))
    for i in range(3):
        joint[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = ps[i]
    x, p = fuse_uncorrelated(xs, ps)
    expected_x, expected_p = least_squares(list(xs), joint)
    assert x == pytest.approx(expected_x, rel=1e-8, abs=1e-10)
    assert p == pytest.approx(expected_p, rel=1e-8, abs=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_two_correlated_estimates_fuse_as_least_squares(seed: int) -> None:
    """Cross-covariance that is not symmetric: P_12 = P_21^T, not P_21 as printed."""
    rng = np.random.default_rng(seed)
    n = 3
    joint = covariance(rng, 2 * n, np.ones(2 * n))
    p_11, p_12, p_22 = joint[:n, :n], joint[:n, n:], joint[n:, n:]
    assert np.abs(p_12 - p_12.T).max() > 0.1
    x_1, x_2 = rng.standard_normal((2, n))
    x, p = fuse_correlated(x_1, p_11, x_2, p_22, p_12)
    expected_x, expected_p = least_squares([x_1, x_2], joint)
    assert x == pytest.approx(expected_x, rel=1e-8, abs=1e-9)
    assert p == pytest.approx(expected_p, rel=1e-8, abs=1e-9)


def test_correlated_formula_without_correlation_is_the_uncorrelated_one() -> None:
    rng = np.random.default_rng(9)
    p_1, p_2 = covariance(rng, 4, np.ones(4)), covariance(rng, 4, np.ones(4))
    x_1, x_2 = rng.standard_normal((2, 4))
    x, p = fuse_correlated(x_1, p_1, x_2, p_2, np.zeros((4, 4)))
    expected = fuse_uncorrelated(np.array([x_1, x_2]), np.array([p_1, p_2]))
    assert x == pytest.approx(expected[0])
    assert p == pytest.approx(expected[1])


def test_one_estimate_twice_is_refused() -> None:
    p = np.eye(2)
    with pytest.raises(np.linalg.LinAlgError):
        fuse_correlated(np.zeros(2), p, np.zeros(2), p, p)


def test_information_of_states_nine_powers_apart() -> None:
    p = covariance(np.random.default_rng(3), 7, SCALES)
    product = information(p) @ p
    assert product == pytest.approx(np.eye(7), abs=1e-2)
    unit = product * SCALES[:, None] / SCALES
    assert unit == pytest.approx(np.eye(7), abs=1e-9)


# --------------------------------------------------------------------------- kernels


def test_factor_and_inverse() -> None:
    a = covariance(np.random.default_rng(1), 7, np.ones(7))
    factor, inverse = a.copy(), np.empty((7, 7))
    assert cholesky(factor)
    upper = np.triu(factor)
    assert upper.T @ upper == pytest.approx(a)
    inverse_of_factor(factor, inverse)
    assert inverse == pytest.approx(np.linalg.inv(a))
    assert not cholesky(np.diag([1.0, -1.0]))
    assert not cholesky(np.diag([1.0, np.nan]))


class Bank:
    """Three estimates of 7 states in matrices of 9 rows; slots 2 and 8 are not used."""

    def __init__(self, seed: int = 4, scales: Array = SCALES) -> None:
        rng = np.random.default_rng(seed)
        self.order = np.array([0, 1, 6, 7, 3, 4, 5])
        self.covs, self.dxs = np.zeros((3, 9, 9)), np.zeros((3, 9))
        for k in range(3):
            p = covariance(rng, 7, scales * 3.0**k)
            self.covs[k][np.ix_(self.order, self.order)] = p
            self.dxs[k, self.order] = rng.standard_normal(7) * scales
        self.weight = np.array([1.0, 1.0, 1.0])
        self.infos, self.vectors = np.zeros((4, 7, 7)), np.zeros((4, 7))
        self.scale, self.fused = np.zeros(7), np.zeros((7, 7))
        self.estimate, self.trace = np.zeros(7), np.zeros(3)

    def combine(self) -> bool:
        return combine(
            *(self.covs, self.dxs, self.weight, self.order, self.infos, self.vectors),
            *(self.scale, self.fused, self.estimate, self.trace),
        )

    def difference(self, k: int, tested: int) -> float:
        return difference(
            *(self.covs[k], self.dxs[k], self.order, self.infos, self.vectors, self.scale),
            *(k, tested),
        )

    def part(self, k: int) -> tuple[Array, Array]:
        return self.dxs[k, self.order], self.covs[k][np.ix_(self.order, self.order)]


@pytest.mark.parametrize("used", [(0, 1, 2), (0, 2), (1,)])
def test_kernel_fuses_as_the_formula(used: tuple[int, ...]) -> None:
    b = Bank()
    b.weight[:] = [float(k in used) for k in range(3)]
    assert b.combine()
    parts = [b.part(k) for k in used]
    x, p = fuse_uncorrelated(np.array([x for x, _ in parts]), np.array([p for _, p in parts]))
    sigma = np.sqrt(np.diag(p))
    assert (b.estimate - x) / sigma == pytest.approx(np.zeros(7), abs=1e-9)
    assert b.fused / np.outer(sigma, sigma) == pytest.approx(p / np.outer(sigma, sigma), abs=1e-9)


def test_a_weight_is_a_part_of_the_information() -> None:
    b = Bank()
    b.weight[:] = [0.25, 1.0, 0.0]
    assert b.combine()
    first = b.fused.copy()
    b.covs[0] /= 0.25
    b.weight[:] = [1.0, 1.0, 0.0]
    assert b.combine()
    assert b.fused == pytest.approx(first, rel=1e-9)


def test_a_singular_covariance_is_made_less_sure_not_refused() -> None:
    """Two states fully correlated, as after hours without a measurement."""
    b = Bank()
    p = b.covs[1]
    p[:, 0] = p[:, 4] * 1e-5
    p[0, :] = p[4, :] * 1e-5
    p[0, 0] = p[4, 4] * 1e-10
    assert b.combine()
    assert np.isfinite(b.fused).all()
    assert (np.diag(b.fused) > 0.0).all()
    b.covs[1] = np.nan
    assert not b.combine()


def test_difference_is_that_of_the_marginals() -> None:
    b = Bank()
    assert b.combine()
    for k in range(3):
        others = [b.part(j) for j in range(3) if j != k]
        x_o, p_o = fuse_uncorrelated(
            np.array([x for x, _ in others]), np.array([p for _, p in others])
        )
        x, p = b.part(k)
        d, s = (x - x_o)[-3:], (p + p_o)[-3:, -3:]
        assert b.difference(k, 3) == pytest.approx(float(d @ np.linalg.solve(s, d)), rel=1e-7)


def test_difference_of_honest_estimates_is_chi_square() -> None:
    rng = np.random.default_rng(11)
    b = Bank(scales=np.ones(7))
    roots = [np.linalg.cholesky(b.part(k)[1]) for k in range(3)]
    found = []
    for _ in range(2000):
        for k in range(3):
            b.dxs[k, b.order] = roots[k] @ rng.standard_normal(7)
        assert b.combine()
        found.append(b.difference(1, 3))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * 2000) / 2000
    assert low <= np.mean(found) <= high
    assert np.mean(np.array(found) > chi2.ppf(0.99, 3)) == pytest.approx(0.01, abs=0.008)


def test_the_others_of_a_single_estimate_know_nothing() -> None:
    b = Bank()
    b.weight[:] = [1.0, 0.0, 0.0]
    assert b.combine()
    assert b.difference(0, 3) == 0.0


def test_carrying_a_bank_is_propagation_with_its_share_of_noise() -> None:
    rng = np.random.default_rng(2)
    b = Bank(scales=np.ones(7))
    phi = np.eye(9) + 0.1 * rng.standard_normal((9, 9))
    noise = covariance(rng, 9, 0.1 * np.ones(9))
    shares = np.array([0.5, 0.3, 0.2])
    before = covariance(rng, 9, np.ones(9))
    after = phi @ before @ phi.T + noise
    covs, dxs = b.covs.copy(), b.dxs.copy()
    carry(covs, dxs, shares, phi, before, after)
    for k in range(3):
        assert covs[k] == pytest.approx(phi @ b.covs[k] @ phi.T + noise / shares[k], abs=1e-10)
        assert dxs[k] == pytest.approx(phi @ b.dxs[k], abs=1e-12)
