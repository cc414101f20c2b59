"""Least squares with priors, and intervals that count on residuals which hang together within a window."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from scipy.special import stdtrit

Floats = NDArray[np.float64]
Predict = Callable[[Floats], Floats]
"""Residuals (guess, window, sample) for guesses (guess, parameter), in standard deviations of the noise."""

STEP = 1e-3  # of a difference quotient, in scales
TOGETHER = 25.0  # so many residuals are worth one against a prior, since they hang together: at first
LEVEL = 0.95
TOLD = 0.5  # a parameter whose deviation is more than this share of the prior's is not told
LINKED = 0.9  # a correlation worth naming
MOST_STEPS, ENOUGH = 60, 5e-4  # of a search; it ends where a step gains less, as a share
LEAST_DAMPING, DAMPED, MOST_REFUSED = 1e-3, 10.0, 4  # of a step, in squares of slopes; times that
KEPT = 0.5  # of what a step promised, with which the next one is damped less
ROUNDS = 2  # of weighing windows by how well they are explained


class Unknown(NamedTuple):
    """A parameter that is sought: where to begin, and what is known of it beforehand."""

    key: str
    start: float
    prior: float
    deviation: float  # of the prior
    low: float
    high: float


class Found(NamedTuple):
    """A parameter as the logs tell it; NaN bounds do not occur."""

    value: float
    low: float
    high: float
    told: bool  # the logs say more about it than was known beforehand

    def moved(self, by: float) -> Found:
        """The same of something that is more by a constant."""
        return Found(self.value + by, self.low + by, self.high + by, self.told)


class Fit(NamedTuple):
    """What came of a fit."""

    keys: tuple[str, ...]
    x: Floats
    covariance: Floats
    told: tuple[bool, ...]
    quantile: float  # half an interval in standard deviations
    residuals: Floats  # (window, sample), in standard deviations of the noise, not weighted
    shift: (
        Floats  # what each parameter has moved by where something was done otherwise that should not matter
    )

    @property
    def by_key(self) -> dict[str, float]:
        """The parameters."""
        return dict(zip(self.keys, self.x.tolist(), strict=True))

    def found(self, **parts: float) -> Found:
        """A sum of parameters, each times a factor, with its interval."""
        factors = np.array([parts.get(key, 0.0) for key in self.keys])
        value = float(factors @ self.x)
        spread = self.quantile**2 * factors @ self.covariance @ factors
        half = float(np.sqrt(max(0.0, spread) + (factors @ self.shift) ** 2))
        told = all(t for t, factor in zip(self.told, factors, strict=True) if factor)
        return Found(value, value - half, value + half, told)

    def linked(self) -> list[tuple[str, str, float]]:
        """Pairs that the logs hardly tell apart, with their correlation."""
        s = np.sqrt(np.diag(self.covariance))
        r = self.covariance / np.outer(s, s)
        pairs = [(i, j) for i in range(len(s)) for j in range(i) if abs(r[i, j]) > LINKED]
        return [(self.keys[j], self.keys[i], float(r[i, j])) for i, j in pairs]


def fit(predict: Predict, unknowns: Sequence[Unknown], rounds: int = ROUNDS) -> Fit:
    """The most likely parameters.

    Windows that the model explains worse than others count for less, so that a push by hand spoils nothing.

    Args:
        predict: the residuals of many guesses at once.
        unknowns: what is sought.
        rounds: of weighing the windows; the first one has them all alike.
    """
    scale = np.array([u.deviation for u in unknowns])
    prior = np.array([u.prior for u in unknowns])
    low, high = np.array([u.low for u in unknowns]), np.array([u.high for u in unknowns])
    x = np.clip([u.start for u in unknowns], low, high) / scale
    weights: Floats | float = 1.0
    together = TOGETHER
    for _ in range(rounds):
        x, residuals, slopes = _solved(predict, x, scale, prior, low, high, weights, together)
        together = _together(weights * residuals)
        by_window = np.sqrt((residuals**2).mean(axis=1))
        usual = max(float(np.median(by_window)), 1e-9)
        weights = (1.0 / np.maximum(by_window, usual))[:, None]
    return _with_intervals(x, residuals, slopes, weights, unknowns, scale, together)


def _linear(predict: Predict, x: Floats, scale: Floats, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Residuals, and their slopes with each parameter in units of its scale: (parameter, window, sample)."""
    steps = np.where((x + STEP) * scale > high, -STEP, STEP)
    guesses = np.vstack([x, x + np.diag(steps)]) * scale
    found = predict(np.clip(guesses, low, high))
    return found[0], (found[1:] - found[0]) / steps[:, None, None]


def _together(residuals: Floats) -> float:
    """How many residuals of a window are worth one, by how far their sum goes beyond that of noise."""
    sums, squares = residuals.sum(axis=1), (residuals**2).sum()
    return float(np.clip((sums**2).sum() / max(squares, 1e-12), TOGETHER, residuals.shape[1]))


def _solved(
    predict: Predict, x: Floats, scale: Floats, prior: Floats, low: Floats, high: Floats,
    weights: Floats | float, together: float,
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Levenberg's and Marquardt's way within the bounds: damped by how steps keep their promise.

    Returns:
        Where it ends, with residuals and slopes there.
    """

    def cost(at: Floats, r: Floats) -> float:
        return float(((weights * r) ** 2).sum() + together * ((at - prior / scale) ** 2).sum())

    here, slopes = _linear(predict, x, scale, low, high)
    now, damping, refused = cost(x, here), LEAST_DAMPING, 0
    for _ in range(MOST_STEPS):
        weighted = (weights * slopes).reshape(len(x), -1)
        square = weighted @ weighted.T + together * np.eye(len(x))
        gradient = weighted @ (weights * here).ravel() + together * (x - prior / scale)
        root = np.linalg.cholesky(square + damping * np.diag(np.diag(square)))
        bounds = (low / scale - x - 1e-12, high / scale - x + 1e-12)
        step = lsq_linear(root.T, -np.linalg.solve(root, gradient), bounds, method="bvls").x
        promised = -(2.0 * gradient + square @ step) @ step
        if promised < ENOUGH * now:
            break
        there = np.clip(x + step, low / scale, high / scale)
        r, its_slopes = _linear(predict, there, scale, low, high)
        gained = now - cost(there, r)
        if gained <= 0.0:
            damping, refused = DAMPED * damping, refused + 1
            if refused > MOST_REFUSED:
                break
            continue
        x, here, slopes, refused = there, r, its_slopes, 0
        enough = gained < ENOUGH * now and damping == LEAST_DAMPING
        now -= gained
        if gained > KEPT * promised:
            damping = max(LEAST_DAMPING, damping / DAMPED)
        if enough:
            break
    return x, here, slopes


def _with_intervals(
    x: Floats, residuals: Floats, slopes: Floats, weights: Floats | float, unknowns: Sequence[Unknown],
    scale: Floats, together: float,
) -> Fit:  # fmt: skip
    """Covariance of the parameters from the windows' own gradients, whatever the residuals are like."""
    count, windows = len(x), residuals.shape[0]
    square = np.broadcast_to(weights, residuals.shape) ** 2
    gradients = np.einsum("pwt,wt,wt->wp", slopes, square, residuals)
    certain = together**2 * np.eye(count)  # so that what no window tells is as unsure as it was
    information = np.einsum("pwt,wt,qwt->pq", slopes, square, slopes) + np.eye(count) * together
    inverse = np.linalg.inv(information)
    left = max(1, windows - count)
    spread = gradients.T @ gradients * (windows / left) + certain
    covariance = inverse @ spread @ inverse
    told = np.sqrt(np.diag(covariance)) < TOLD
    return Fit(
        tuple(u.key for u in unknowns),
        x * scale,
        covariance * np.outer(scale, scale),
        tuple(bool(t) for t in told),
        float(stdtrit(max(left, 3), 0.5 + 0.5 * LEVEL)),  # of Student's t; scipy.stats is long to load
        residuals,
        np.zeros(count),
    )
