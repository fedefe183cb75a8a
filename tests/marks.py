"""Dots drawn at known places, and where a picture shows them: the ruler of test_sensor and test_augment."""

import numpy as np


def dots(size, points, sigma, ground=80.0, height=100.0):
    """Light (h, w, 3), float32: Gaussian dots at points (N, 2) on grey ground; size is (width, height)."""
    v, u = np.mgrid[: size[1], : size[0]]
    light = np.full((size[1], size[0]), ground)
    for (x, y), peak in zip(points, np.broadcast_to(height, len(points))):
        light += peak * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * sigma**2))
    return np.repeat(light[..., None], 3, axis=2).astype(np.float32)


def measure(picture, points, sigma):
    """How far (N, 2) each dot lies from its point, px, and how high (N,) it is.

    Least squares on the dot, its first derivatives (the shift), its second (blur, round or not) and a
    plane (uneven light): symmetric changes do not count as a shift. The channels are averaged.
    """
    grey = picture.astype(float).mean(axis=2)
    shifts, heights = [], []
    for x, y in points:
        reach = int(np.ceil(3 * sigma))
        u0, v0 = round(float(x)), round(float(y))
        v, u = np.mgrid[max(0, v0 - reach) : v0 + reach + 1, max(0, u0 - reach) : u0 + reach + 1]
        v, u = v[:, u[0] < grey.shape[1]], u[:, u[0] < grey.shape[1]]
        v, u = v[v[:, 0] < grey.shape[0]], u[v[:, 0] < grey.shape[0]]
        a, b = (u - x) / sigma, (v - y) / sigma
        g = np.exp(-(a**2 + b**2) / 2)
        terms = [g, a * g, b * g, a * a * g, b * b * g, a * b * g, np.ones_like(g), a, b]
        fit = np.linalg.lstsq(np.column_stack([t.ravel() for t in terms]), grey[v, u].ravel(), rcond=None)[0]
        # To first order a dot moved by d is g + d a g / sigma; widened by blur, both terms shrink alike.
        shifts.append(sigma * fit[1:3] / fit[0])
        heights.append(fit[0])
    return np.array(shifts), np.array(heights)
