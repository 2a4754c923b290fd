"""Blocks of the multi-scale filter against dense algebra; their wavelet transform."""

from __future__ import annotations

import numpy as np
import pytest
import pywt
from numpy.typing import NDArray

from fusiond.estimators.multiscale.block import begin, fold, newest, predict, rebase
from fusiond.estimators.multiscale.wavelet import wavelet_matrix

Array = NDArray[np.float64]

ORTHONORMAL = [
    name
    for family in ("haar", "db", "sym", "coif")
    for name in pywt.wavelist(family, kind="discrete")
]


# --------------------------------------------------------------------------- wavelet


@pytest.mark.parametrize("scales", [1, 2, 3, 4])
def test_every_orthonormal_wavelet_gives_an_orthonormal_matrix(scales: int) -> None:
    assert len(ORTHONORMAL) > 70
    for name in ORTHONORMAL:
        w = wavelet_matrix(name, scales)
        assert w.shape == (2 ** (scales - 1),) * 2
        np.testing.assert_allclose(w @ w.T, np.eye(len(w)), atol=1e-14)


def test_haar_of_two_scales_is_difference_and_sum() -> None:
    np.testing.assert_allclose(wavelet_matrix("haar", 2), np.array([[1, -1], [1, 1]]) / 2**0.5)


def test_the_coarsest_row_is_the_mean_of_the_block() -> None:
    np.testing.assert_allclose(wavelet_matrix("db3", 4)[-1], np.full(8, 8**-0.5), atol=1e-9)


@pytest.mark.parametrize("name", ["bior2.2", "rbio3.1", "dmey", "mexh", "haa"])
def test_what_is_not_orthonormal_is_refused_by_name(name: str) -> None:
    with pytest.raises(ValueError, match=name) as refused:
        wavelet_matrix(name, 2)
    assert "db1 to db" in str(refused.value)
    assert "dmey," not in str(refused.value)


# --------------------------------------------------------------------------- block algebra


def block_matrices(phi: Array) -> tuple[Array, Array]:
    """A (M n, M n) and B (M n, (2M-1) n) of the step from one block to the next, written out."""
    steps, n = phi.shape[:2]
    m = (steps + 1) // 2

    def transition(start: int, end: int) -> Array:
        total = np.eye(n)
        for k in range(start, end):
            total = phi[k] @ total
        return total

    a, b = np.zeros((m * n, m * n)), np.zeros((m * n, steps * n))
    for row in range(m):
        here = slice(row * n, (row + 1) * n)
        for i in range(m):
            a[here, i * n : (i + 1) * n] = transition(i, m + row) / m
        for k in range(m + row):
            b[here, k * n : (k + 1) * n] = min(k + 1, m) / m * transition(k + 1, m + row)
    return a, b


@pytest.mark.parametrize(("name", "scales"), [("haar", 1), ("haar", 2), ("haar", 3), ("db2", 4)])
def test_transformed_block_filter_is_the_dense_one(name: str, scales: int) -> None:
    rng = np.random.default_rng(scales)
    w = wavelet_matrix(name, scales).copy()
    m, n = len(w), 5
    phi = np.eye(n) + 0.3 * rng.standard_normal((2 * m - 1, n, n))
    root = rng.standard_normal((2 * m - 1, n, n))
    q = 0.1 * root @ root.transpose(0, 2, 1)
    a, b = block_matrices(phi)
    x = [rng.standard_normal(n)]
    noise = rng.standard_normal((2 * m - 1, n))
    for transition, white in zip(phi, noise, strict=True):
        x.append(transition @ x[-1] + white)
    # Equations 8 and 9 are an identity: no approximation in A and B themselves.
    identity = a @ np.concatenate(x[:m]) + b @ noise.ravel()
    np.testing.assert_allclose(identity, np.concatenate(x[m:]), rtol=1e-10)

    root = rng.standard_normal((m * n, m * n))
    mean, p = rng.standard_normal(m * n), root @ root.T
    q_all = np.zeros((len(q) * n, len(q) * n))
    for k, white_cov in enumerate(q):
        q_all[k * n : (k + 1) * n, k * n : (k + 1) * n] = white_cov
    mean_next, p_next = a @ mean, a @ p @ a.T + b @ q_all @ b.T
    z, h, r = rng.standard_normal(2 * m), rng.standard_normal((2 * m, n)), rng.uniform(1, 2, 2 * m)
    c = np.zeros((2 * m, m * n))
    for row in range(2 * m):
        c[row, row // 2 * n : (row // 2 + 1) * n] = h[row]
    gain = p_next @ c.T @ np.linalg.inv(c @ p_next @ c.T + np.diag(r))
    expected, expected_p = mean_next + gain @ (z - c @ mean_next), p_next - gain @ c @ p_next

    t = np.kron(w, np.eye(n))
    got, got_p = np.empty(m * n), np.empty((m * n, m * n))
    predict(w, t @ mean, t @ p @ t.T, phi, q, got, got_p)
    scale = np.abs(p_next).max()
    np.testing.assert_allclose(t.T @ got, mean_next, rtol=1e-9)
    np.testing.assert_allclose(t.T @ got_p @ t, p_next, atol=1e-11 * scale)
    fold(w, got, got_p, 0, 0, m, z, h, r, np.arange(2, 2 * m + 1, 2))
    np.testing.assert_allclose(t.T @ got, expected, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(t.T @ got_p @ t, expected_p, atol=1e-9 * scale)
    last, last_p = np.empty(n), np.empty((n, n))
    newest(w, got, got_p, last, last_p)
    np.testing.assert_allclose(last, (t.T @ got)[-n:], rtol=1e-9)
    np.testing.assert_allclose(last_p, (t.T @ got_p @ t)[-n:, -n:], atol=1e-11 * scale)


def test_a_block_that_begins_holds_the_ordinary_prediction() -> None:
    """Equations 21 and 22, and after its measurements the last element is a Kalman filter's."""
    rng = np.random.default_rng(5)
    w, n = wavelet_matrix("haar", 3).copy(), 4
    phi = np.eye(n) + 0.2 * rng.standard_normal((3, n, n))
    q = np.repeat(0.2 * np.eye(n)[None], 3, axis=0)
    mean, p = rng.standard_normal(n), np.diag([1.0, 2.0, 3.0, 4.0])
    z, h, r = rng.standard_normal(3), rng.standard_normal((3, n)), np.array([0.5, 1.0, 2.0])
    block, block_p = np.empty(4 * n), np.empty((4 * n, 4 * n))
    begin(w, mean, p, phi, q, block, block_p)
    fold(w, block, block_p, 1, 0, 3, z, h, r, np.array([1, 2, 3]))
    for k in range(3):
        mean, p = phi[k] @ mean, phi[k] @ p @ phi[k].T + q[k]
        gain = p @ h[k] / (h[k] @ p @ h[k] + r[k])
        mean, p = mean + gain * (z[k] - h[k] @ mean), p - np.outer(gain, h[k] @ p)
    last, last_p = np.empty(n), np.empty((n, n))
    newest(w, block, block_p, last, last_p)
    np.testing.assert_allclose(last, mean, rtol=1e-10)
    np.testing.assert_allclose(last_p, p, atol=1e-12)


def test_rebasing_takes_one_trajectory_off_everything() -> None:
    rng = np.random.default_rng(6)
    w, n = wavelet_matrix("haar", 2).copy(), 3
    phi = np.eye(n) + 0.2 * rng.standard_normal((3, n, n))
    u, z, h = rng.standard_normal((3, n)), rng.standard_normal(4), rng.standard_normal((4, n))
    ends = np.array([1, 3, 4])
    t = np.array([u[0], phi[1] @ u[0], phi[2] @ phi[1] @ u[0]])
    kron = np.kron(w, np.eye(n))
    means = rng.standard_normal((2, 2 * n))
    expected = [means[i] - kron @ t[i : i + 2].ravel() for i in range(2)]
    expected_u, expected_z = u - t, z - np.sum(h * t[[0, 1, 1, 2]], axis=1)
    rebase(w, phi, u, z, h, ends, means)
    np.testing.assert_allclose(means, expected)
    np.testing.assert_allclose(u, expected_u)
    np.testing.assert_allclose(z, expected_z)
    assert not u[0].any()
