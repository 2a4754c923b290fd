"""Widths of covariances of a vehicle's filters, by which its kernels are compiled and linked."""

from __future__ import annotations

from fusiond.navigator.navigator import Navigator


def kernel_widths(navigator: Navigator) -> set[int]:
    """Row widths of the covariances, with and without an inertial unit."""
    return {navigator.model.width, navigator.without_imu.model.width}
