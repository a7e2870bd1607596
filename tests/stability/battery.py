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

from pileus_service.shot import (
    Camera,
    DomeLight,
    Image,
    Look,
    Sampling,
    Shot,
    Transport,
    Volume,
)
from pileus_worker import deciding, scene
from pileus_worker.sampling import Sampler
from stability.hazards import BEAUTY, HALVES, PHYSICAL, Hazard, Light

Pixels = NDArray[np.floating[Any]]

METHODS = [*core.METHODS, "auto"]
# What `auto` is asked for: more than most hazards meet with the samples they have.
TOLERANCE = 0.1

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
        method: str,
        samples: tuple[int, int],
        *,
        looks: Sequence[Look] = PHYSICAL,
        max_bounces: int | None = None,
        lights: Sequence[Light] | None = None,
        volume: core.Volume | None = None,
        threads: int = 1,
        seed: int = 1,
    ) -> core.Partial:
        """The hazard's picture, or under other lights the same with a background. `auto` takes no
        more samples than it wants."""
        shot = self.shot(method, samples[1], looks, max_bounces, lights, seed)
        volume = volume or self.volume
        control = core.Control()
        resolved = deciding.resolve(shot, 1, lambda: volume, threads=threads, control=control)
        view = scene.make_scene(shot, 1, volume)
        sampler = Sampler(view, shot, resolved, frame=1, threads=threads, control=control)
        return sampler.parts([(0, 0, *self.size)], samples)[0]

    def shot(
        self,
        method: str,
        samples: int,
        looks: Sequence[Look],
        max_bounces: int | None,
        lights: Sequence[Light] | None,
        seed: int,
    ) -> Shot:
        hazard, (width, height) = self.hazard, self.size
        return Shot(
            name="hazard",
            frames="1",
            image=Image(
                width=width, height=height, output="hazard.exr", background=lights is not None
            ),
            volumes=(
                Volume(
                    cache="hazard.vdb",
                    extinction=hazard.extinction,
                    albedo=(hazard.albedo,) * 3,
                    anisotropy=hazard.anisotropy,
                ),
            ),
            camera=Camera(position=hazard.position, look_at=hazard.look_at, fov=hazard.fov),
            lights=tuple(hazard.lights(self.folder) if lights is None else lights),
            transport=Transport(method=method, max_bounces=max_bounces, looks=tuple(looks)),
            sampling=Sampling(
                samples=samples, seed=seed, tolerance=TOLERANCE if method == "auto" else None
            ),
        )

    def truth(self, max_bounces: int | None) -> Estimate:
        """By `reference`, with numbers of its own."""
        count = self.share(self.detail.truth_paths)
        return estimate(
            self.render("reference", (0, count), max_bounces=max_bounces, threads=0, seed=99)
        )


def estimate(partial: core.Partial, look: str = BEAUTY) -> Estimate:
    channels = partial.channels(look)
    values, variance = (channels[name].astype(np.float64) for name in ("G", "variance.G"))
    if partial.samples[1] - partial.samples[0] == 1:
        # One sample tells no variance; that over the picture is no less.
        variance = np.full_like(values, values.var())
    return Estimate(float(values.mean()), float(np.sqrt(variance.sum()) / values.size))


def bounces(method: str) -> int | None:
    """A method's own; None: unlimited."""
    if method == "auto":
        return None
    bounces: int | None = core.Transport(method=method, looks=[core.Look(name="")]).max_bounces
    return bounces


def run(stage: Stage, method: str) -> Cell:
    """Renders a hazard with a method, and holds every guard against what comes."""
    hazard, count = stage.hazard, stage.samples
    # The contrast approximation is made for weights below one.
    looks = [*(HALVES if method == "contrast" else PHYSICAL), *hazard.looks]

    begun = time.perf_counter()
    partial = stage.render(method, (0, count), looks=looks)
    taken = partial.samples[1]
    seconds = time.perf_counter() - begun
    broken = [
        f"{look}: {trouble}"
        for look in partial.looks
        for trouble in faults(partial.channels(look), taken)
    ]

    again = stage.render(
        method, (0, count), looks=looks, volume=hazard.volume(stage.folder), threads=2
    )
    if not same_bits(partial, again):
        broken.append("other bits on another run")

    burnt = stage.render(
        method, (0, count), lights=[DomeLight(type="dome", radiance=(1.0, 1.0, 1.0))]
    )
    furnace = estimate(burnt)
    broken += [
        f"furnace: {trouble}" for trouble in faults(burnt.channels(BEAUTY), burnt.samples[1])
    ]
    most = float(bounces(method) or 1) if method in MAY_CREATE_ENERGY else 1.0
    if furnace.mean > most * (1 + 1e-4) + CHANCE * furnace.error:
        broken.append(f"the furnace has {furnace.mean:.4g}, and {most:g} is the most")
    least = 1.0 - TOLERANCE - CHANCE * furnace.error
    if method == "auto" and furnace.mean < least and not burnt.bounded_paths:
        broken.append(f"the furnace has {furnace.mean:.4g}: the model is too small")

    picture = estimate(partial, BEAUTY)
    paths = taken * math.prod(stage.size)
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
