"""One hazard with one method: what it gives, what that costs, and which guard did not hold."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pileus_core as core
from numpy.typing import NDArray

from stability.hazards import BEAUTY, HALVES, PHYSICAL, Hazard, Light

Pixels = NDArray[np.floating[Any]]

# Methods that do not promise to keep the furnace's energy, and what bounds them instead: the sum
# over their orders, none of which is more than the furnace.
MAY_CREATE_ENERGY = {"contrast", "multiple"}
# How far chance may carry a mean past a bound, in standard errors.
CHANCE = 5.0


@dataclass(frozen=True)
class Detail:
    """How closely to look: the picture's edge, the paths over it, and those of the truth."""

    edge: int
    paths: int
    truth_paths: int


SMALL = Detail(edge=6, paths=144, truth_paths=0)
FULL = Detail(edge=16, paths=1 << 13, truth_paths=1 << 15)


@dataclass(frozen=True)
class Estimate:
    """A mean over a picture and its standard error."""

    mean: float
    error: float


@dataclass
class Cell:
    """What happened."""

    picture: Estimate
    sigma: float  # of one sample, as a share of the mean
    microseconds: float  # a sample, on one thread
    bounded: int  # paths that the bound on work has ended
    furnace: Estimate
    truth: Estimate | None = None
    broken: list[str] = field(default_factory=list)  # guards that did not hold


@dataclass(frozen=True)
class Stage:
    """A hazard made ready to render, in a folder of its own."""

    hazard: Hazard
    folder: Path
    volume: core.Volume
    detail: Detail

    @classmethod
    def of(cls, hazard: Hazard, folder: Path, detail: Detail) -> "Stage":
        return cls(hazard, folder, hazard.volume(folder), detail)

    @property
    def size(self) -> tuple[int, int]:
        return self.hazard.size or (self.detail.edge, self.detail.edge)

    @property
    def samples(self) -> int:
        return self.hazard.samples or self.share(self.detail.paths)

    def share(self, paths: int) -> int:
        """What a pixel gets of so many paths."""
        return max(1, paths // (self.hazard.dear * math.prod(self.size)))

    def render(
        self,
        transport: core.Transport,
        samples: tuple[int, int],
        *,
        lights: Sequence[Light] | None = None,
        volume: core.Volume | None = None,
        threads: int = 1,
        seed: int = 1,
    ) -> core.Partial:
        """The hazard's picture, or under other lights the same with a background."""
        hazard, (width, height) = self.hazard, self.size
        scene = core.Scene(
            volume=volume or self.volume,
            extinction=hazard.extinction,
            albedo=(hazard.albedo,) * 3,
            anisotropy=hazard.anisotropy,
            camera=hazard.camera(),
            lights=hazard.lights(self.folder) if lights is None else lights,
            width=width,
            height=height,
            background=lights is not None,
        )
        return core.render(
            scene,
            transport,
            bucket=(0, 0, width, height),
            samples=samples,
            seed=seed,
            frame=1,
            threads=threads,
        )

    def truth(self, max_bounces: int | None) -> Estimate:
        """By `reference`, with numbers of its own."""
        transport = core.Transport(method="reference", max_bounces=max_bounces, looks=PHYSICAL)
        count = self.share(self.detail.truth_paths)
        return estimate(self.render(transport, (0, count), threads=0, seed=99))


def estimate(partial: core.Partial, look: str = BEAUTY) -> Estimate:
    channels = partial.channels(look)
    values, variance = (channels[name].astype(np.float64) for name in ("G", "variance.G"))
    if partial.samples[1] - partial.samples[0] == 1:
        # One sample tells no variance; that over the picture is no less.
        variance = np.full_like(values, values.var())
    return Estimate(float(values.mean()), float(np.sqrt(variance.sum()) / values.size))


def run(stage: Stage, method: str) -> Cell:
    """Renders a hazard with a method, and holds every guard against what comes."""
    hazard, count = stage.hazard, stage.samples
    # The contrast approximation is made for weights below one.
    own = HALVES if method == "contrast" else PHYSICAL
    transport = core.Transport(method=method, looks=[*own, *hazard.looks])

    begun = time.perf_counter()
    partial = stage.render(transport, (0, count))
    seconds = time.perf_counter() - begun
    broken = [
        f"{look}: {trouble}"
        for look in partial.looks
        for trouble in faults(partial.channels(look), count)
    ]

    again = stage.render(transport, (0, count), volume=hazard.volume(stage.folder), threads=2)
    if not same_bits(partial, again):
        broken.append("other bits on another run")

    white = [core.DomeLight(radiance=(1.0, 1.0, 1.0))]
    physical = core.Transport(method=method, looks=PHYSICAL)
    burnt = stage.render(physical, (0, count), lights=white)
    furnace = estimate(burnt)
    broken += [f"furnace: {trouble}" for trouble in faults(burnt.channels(BEAUTY), count)]
    most = float(physical.max_bounces or 1) if method in MAY_CREATE_ENERGY else 1.0
    if furnace.mean > most * (1 + 1e-4) + CHANCE * furnace.error:
        broken.append(f"the furnace has {furnace.mean:.4g}, and {most:g} is the most")

    picture = estimate(partial, BEAUTY)
    paths = count * math.prod(stage.size)
    return Cell(
        picture=picture,
        sigma=picture.error * math.sqrt(paths) / picture.mean if picture.mean else 0.0,
        microseconds=seconds / paths * 1e6,
        bounded=partial.bounded_paths,
        furnace=furnace,
        broken=broken,
    )


def faults(channels: dict[str, Pixels], samples: int) -> list[str]:
    """What no image may hold."""
    found = []
    for name, values in channels.items():
        if not np.isfinite(values).all():
            found.append(f"{name} has NaN or infinite pixels")
        elif (values < 0).any():
            found.append(f"{name} has negative pixels")
    if (channels["A"] > 1).any():
        found.append("A is over 1")
    if samples == 1 and channels["variance.G"].any():
        found.append("one sample claims a variance")
    return found


def same_bits(one: core.Partial, other: core.Partial) -> bool:
    if one.bounded_paths != other.bounded_paths:
        return False
    return all(
        np.array_equal(a.view(np.uint32), b.view(np.uint32))
        for look in one.looks
        for a, b in zip(one.channels(look).values(), other.channels(look).values(), strict=True)
    )
