"""How far images are from the truth, with what is bias and what is noise told apart.

The truth is two independent halves A and B. A product (x - A)(x - B) then has the mean (x - r)^2
without the truth's own noise, and for two independent renders x and y, (x - A)(y - B) has the mean
of the squared bias alone. No variance has to be known and subtracted.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float64]
TRIMMED = 0.001  # of the pixels, the worst: a few fireflies must not decide
TILE = 8
RESAMPLES = 400


@dataclass(frozen=True)
class Truth:
    """Two independent halves of shape (height, width, 3)."""

    a: Image
    b: Image

    @property
    def mean(self) -> Image:
        return (self.a + self.b) / 2

    @property
    def weight(self) -> Image:
        """What makes a squared error a relative one."""
        return np.asarray(1 / (self.mean**2 + 0.01))

    @property
    def noise(self) -> float:
        """The relMSE that the truth itself has for its noise."""
        return float(np.mean((self.a - self.b) ** 2 / 4 * self.weight))


@dataclass(frozen=True)
class Estimate:
    """A value with its bootstrap interval of 90 %."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Errors:
    """What repeated renders of one kind are worth; all are relMSE but the last two."""

    rel_mse: Estimate
    trimmed: Estimate
    noise: float
    bias: Estimate
    mean_ratio: float
    mean_ratio_error: float


def errors(renders: Sequence[tuple[Sequence[Image], Truth]]) -> Errors:
    """Over the frames of a scene: each with its repeats, two or more, and its truth."""
    total = np.concatenate([_tiles(_error_maps(images, truth)) for images, truth in renders], 1)
    trimmed = np.concatenate([_tiles(_trim(images, truth)) for images, truth in renders], 1)
    bias = np.concatenate([_tiles(_bias_map(images, truth)[None]) for images, truth in renders], 1)
    noise = [
        np.mean(np.var(np.stack(images), axis=0, ddof=1) * truth.weight)
        for images, truth in renders
    ]
    ratio, ratio_error = _mean_ratio(renders)
    return Errors(
        rel_mse=_bootstrap(total),
        trimmed=_bootstrap(trimmed),
        noise=float(np.mean(noise)),
        bias=_bootstrap(bias),
        mean_ratio=ratio,
        mean_ratio_error=ratio_error,
    )


def error(image: Image, truth: Truth) -> float:
    """The relMSE of one render without the truth's noise."""
    return float(np.mean(_error_maps([image], truth)))


def trimmed_error(image: Image, truth: Truth) -> float:
    """The relMSE of one render without its worst pixels and without the truth's noise."""
    return float(np.mean(_trim([image], truth)))


def relative_noise(images: Sequence[Image], truth: Truth) -> float:
    """The repeats' variance relative to their own mean, each exposed to be as bright as the truth
    is: what methods of different truths share. Without that the least that the relMSE takes for
    bright would count one that leaves out most of the light as free of noise."""
    stack = np.stack(images)
    stack *= truth.mean.mean() / stack.mean()
    return float(np.mean(np.var(stack, axis=0, ddof=1) / (stack.mean(axis=0) ** 2 + 0.01)))


def _error_maps(images: Sequence[Image], truth: Truth) -> Image:
    """By repeat and pixel: the squared relative error without the truth's noise."""
    x = np.stack(images)
    return np.asarray(np.mean((x - truth.a) * (x - truth.b) * truth.weight, axis=-1))


def _trim(images: Sequence[Image], truth: Truth) -> Image:
    """The same with each repeat's worst pixels out of the mean."""
    maps = _error_maps(images, truth)
    seen = np.mean((np.stack(images) - truth.mean) ** 2 * truth.weight, axis=-1)
    limit = np.quantile(seen.reshape(len(images), -1), 1 - TRIMMED, axis=1)
    keep = seen <= limit[:, None, None]
    return np.asarray(np.where(keep, maps, 0.0) / keep.mean(axis=(1, 2), keepdims=True))


def _bias_map(images: Sequence[Image], truth: Truth) -> Image:
    """By pixel: the squared relative bias, from all pairs of distinct repeats."""
    x = np.stack(images)
    from_a, from_b = x - truth.a, x - truth.b
    pairs = from_a.sum(axis=0) * from_b.sum(axis=0) - (from_a * from_b).sum(axis=0)
    return np.asarray(np.mean(pairs * truth.weight, axis=-1) / (len(x) * (len(x) - 1)))


def _mean_ratio(renders: Sequence[tuple[Sequence[Image], Truth]]) -> tuple[float, float]:
    """The images' mean over the truth's, and its standard error, the truth's included."""
    means = np.array([[image.mean() for image in images] for images, _ in renders])
    truths = np.array([[truth.a.mean(), truth.b.mean()] for _, truth in renders])
    truth = truths.mean()
    variance = np.var(means, axis=1, ddof=1).sum() / means.shape[1] / len(means) ** 2
    own = np.var(truths, axis=1, ddof=1).sum() / 2 / len(truths) ** 2
    return float(means.mean() / truth), float(np.sqrt(variance + own) / truth)


def _tiles(maps: Image) -> Image:
    """The means over square tiles, of shape (repeats, tiles); edges make smaller tiles."""
    repeats, height, width = maps.shape
    rows, columns = range(0, height, TILE), range(0, width, TILE)
    sums = np.add.reduceat(np.add.reduceat(maps, rows, axis=1), columns, axis=2)
    return np.asarray(sums.reshape(repeats, -1) * (len(rows) * len(columns) / (height * width)))


def _bootstrap(tiles: Image) -> Estimate:
    """Repeats and tiles are drawn anew, with replacement: pixels near each other may err alike."""
    random = np.random.default_rng(1)
    repeats, count = tiles.shape
    drawn = [
        tiles[random.integers(repeats, size=repeats)][:, random.integers(count, size=count)].mean()
        for _ in range(RESAMPLES)
    ]
    low, high = np.quantile(drawn, [0.05, 0.95])
    return Estimate(float(tiles.mean()), float(low), float(high))
