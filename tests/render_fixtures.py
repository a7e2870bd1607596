"""What the rendering tests share: the real data beside the repository, scenes on it, statistics."""

from collections.abc import Sequence
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import pileus_core
import pytest
from numpy.typing import NDArray

Image = NDArray[np.float64]

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def data_file(name: str) -> Path:
    """A file of the shared data; skips the test where it is absent."""
    path = DATA / name
    if not path.is_file():
        pytest.skip(f"needs {name} in ../shared/data")
    return path


def physical() -> list[pileus_core.Look]:
    return [pileus_core.Look(name="physical")]


def make_scene(
    volume: pileus_core.Volume,
    camera: pileus_core.Camera,
    lights: Sequence[Any],
    *,
    extinction: float,
    albedo: float = 1.0,
    anisotropy: float = 0.0,
    size: int = 32,
) -> pileus_core.Scene:
    return pileus_core.Scene(
        volume=volume,
        extinction=extinction,
        albedo=(albedo, albedo, albedo),
        anisotropy=anisotropy,
        camera=camera,
        lights=list(lights),
        width=size,
        height=size,
    )


def camera_around(volume: pileus_core.Volume, fov: float = 40.0) -> pileus_core.Camera:
    """Sees all of a volume, from its front and a little above."""
    if volume.world_bounds is None:
        return pileus_core.Camera(position=(0, 0, 2), look_at=(0, 0, 0), up=(0, 1, 0), fov=fov)
    low, high = (np.asarray(corner) for corner in volume.world_bounds)
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    distance = 1.05 * radius / np.sin(np.radians(fov / 2))
    towards = np.array([0.35, 0.3, 0.9])
    position = centre + towards / np.linalg.norm(towards) * distance
    return pileus_core.Camera(
        position=tuple(position), look_at=tuple(centre), up=(0, 1, 0), fov=fov
    )


def render(
    scene: pileus_core.Scene,
    method: str,
    samples: int,
    size: int,
    *,
    max_bounces: int | None = None,
    seed: int = 1,
) -> dict[str, Image]:
    """A whole frame with the physical look, channel by channel."""
    transport = pileus_core.Transport(method=method, max_bounces=max_bounces, looks=physical())
    partial = pileus_core.render(
        scene, transport, bucket=(0, 0, size, size), samples=(0, samples), seed=seed, frame=1
    )
    assert partial.bounded_paths == 0
    channels = partial.channels("physical")
    return {name: values.astype(np.float64) for name, values in channels.items()}


def tiles(image: Image, side: int) -> Image:
    """The means over square tiles of pixels."""
    height, width = image.shape
    split = image.reshape(height // side, side, width // side, side)
    return np.asarray(split.mean(axis=(1, 3)))


def spread(image: Image, reach: int) -> Image:
    """The means over the square neighbourhood of each value."""
    padded = np.pad(image, reach, mode="reflect")
    side = 2 * reach + 1
    windows = np.lib.stride_tricks.sliding_window_view(padded, (side, side))
    return np.asarray(windows.mean(axis=(2, 3)))


def z_limit(confidence: float, tests: int = 1) -> float:
    """How many standard errors the worst of independent estimates may be off (Sidak 1967)."""
    return NormalDist().inv_cdf(0.5 + 0.5 * confidence ** (1 / tests))
