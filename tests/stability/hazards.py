"""The hazards: scenes that are known to break volume renderers, each small and of known content."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pileus_core as core
from numpy.typing import NDArray

from pileus_service.shot import DistantLight, DomeLight, Look

Vec3 = tuple[float, float, float]
Field = NDArray[np.float32]
Block = tuple[tuple[int, int, int], Field]
Light = DistantLight | DomeLight

SIDE = 32  # voxels along a cube of one world unit
FAR = 1e6


def sun(towards: Vec3 = (0.4, 0.7, 0.6), irradiance: float = 3.0, angle: float = 0.0) -> Light:
    direction = (-towards[0], -towards[1], -towards[2])
    return DistantLight(
        type="distant", direction=direction, irradiance=(irradiance,) * 3, angle=angle
    )


def sun_and_sky(_: Path) -> list[Light]:
    return [sun(), DomeLight(type="dome", radiance=(0.3, 0.3, 0.3))]


def straight_sun(_: Path) -> list[Light]:
    """Behind the volume, where the camera looks."""
    return [sun((0.0, 0.0, -1.0))]


def pin_sun(_: Path) -> list[Light]:
    """So small a disc that its radiance is past what a float holds."""
    return [sun(angle=1e-20)]


def spiked_sky(folder: Path) -> list[Light]:
    """A dome of 0.1 with one pixel of 10^6, as a Radiance file: mantissa bytes and an exponent."""

    def texel(value: float) -> bytes:
        mantissa, exponent = np.frexp(value)
        return bytes([int(mantissa * 256)] * 3 + [int(exponent) + 128])

    width, height = 64, 32
    texels = [texel(0.1)] * (width * height)
    texels[8 * width + 20] = texel(FAR)
    path = folder / "spike.hdr"
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n"
    path.write_bytes(head.encode() + b"".join(texels))
    return [DomeLight(type="dome", radiance=(1.0, 1.0, 1.0), texture=str(path))]


BEAUTY = "beauty"
PHYSICAL = (Look(name=BEAUTY),)
# The weights that the authors of the contrast approximation use; with 1, 1, 1 its octaves only add.
HALVES = (Look(name=BEAUTY, a=0.5, b=0.5, c=0.5),)


@dataclass(frozen=True)
class Hazard:
    """A scene where a method may fail, and in how much detail to look at it."""

    name: str
    what: str
    blocks: Callable[[], list[Block]]
    voxel: Vec3 = (1 / SIDE,) * 3
    origin: Vec3 = (-0.5, -0.5, -0.5)
    extinction: float = 20.0
    albedo: float = 1.0
    anisotropy: float = 0.6
    position: Vec3 = (0.5, 0.4, 2.1)
    look_at: Vec3 = (0.0, 0.0, 0.0)
    fov: float = 35.0
    lights: Callable[[Path], list[Light]] = sun_and_sky
    looks: tuple[Look, ...] = ()  # beside the physical one
    size: tuple[int, int] | None = None  # where the picture's own size is the hazard
    samples: int | None = None  # where their number is
    dear: int = 1  # by how much a sample costs more than elsewhere

    def volume(self, folder: Path) -> core.Volume:
        path = folder / "hazard.vdb"
        if not path.exists():
            core.write_grid(str(path), self.blocks(), voxel=self.voxel, origin=self.origin)
        return core.Volume(str(path))


def radius() -> NDArray[np.float64]:
    """The distance of each voxel from the middle of the cube, 1 at its faces."""
    axis = (np.arange(SIDE) - (SIDE - 1) / 2) / (SIDE / 2)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def whole(values: NDArray[np.float64]) -> list[Block]:
    return [((0, 0, 0), values.astype(np.float32))]


def ball(density: float = 1.0) -> list[Block]:
    return whole(np.where(radius() < 0.9, density, 0.0))


def cube(density: float = 1.0, side: int = SIDE) -> list[Block]:
    return whole(np.full((side,) * 3, density))


def pockets() -> list[Block]:
    """A ball with a lattice of round holes that hold exactly nothing."""
    axis = (np.arange(SIDE) % 8 - 3.5) / 4
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    return whole(np.where((radius() < 0.95) & (x * x + y * y + z * z > 0.55), 1.0, 0.0))


def fading() -> list[Block]:
    return whole(np.clip(1.0 - radius(), 0.0, 1.0) ** 6)


def step() -> list[Block]:
    values = np.full((SIDE,) * 3, 0.002)
    values[:, : SIDE // 2] = 20.0
    return whole(values)


def checkerboard() -> list[Block]:
    return whole((np.indices((SIDE,) * 3).sum(axis=0) % 2).astype(np.float64))


def one_voxel() -> list[Block]:
    return [((0, 0, 0), np.ones((1, 1, 1), np.float32))]


def lone_voxel() -> list[Block]:
    return [*ball(), ((100_000, 0, 0), np.ones((1, 1, 1), np.float32))]


def damaged() -> list[Block]:
    ((low, values),) = ball()
    flat = values.reshape(-1)
    flat[::7], flat[1::7], flat[2::7] = np.nan, np.inf, -1.0
    return [(low, values)]


def slab() -> list[Block]:
    return [((0, 0, 0), np.ones((SIDE, SIDE, 2), np.float32))]


ZERO_LOOKS = (
    Look(name="zero", a=0.0, b=0.0, c=0.0),
    Look(name="a0", a=0.0),
    Look(name="b0", b=0.0),
    Look(name="c0", c=0.0),
    Look(name="b_below_a", a=0.9, b=0.3, c=0.5),
    Look(name="b_above_a", a=0.3, b=0.9, c=0.5),
)

HAZARDS = (
    Hazard("vacuum pockets", "holes where the density is exactly 0", pockets, extinction=60),
    Hazard("fading edge", "density falling to 10^-9 without an edge", fading, extinction=200),
    Hazard("thin to dense", "a step from 0.002 to 20 within a voxel", step),
    Hazard("checkerboard", "density 0 and 1 by turns, voxel by voxel", checkerboard, extinction=60),
    Hazard(
        "density 10^6", "a ball 30,000 mean free paths a voxel thick", lambda: ball(1e6), dear=64
    ),
    Hazard(
        "single voxel",
        "one voxel is all there is",
        one_voxel,
        voxel=(1.0,) * 3,
        origin=(0.0,) * 3,
        extinction=4,
    ),
    Hazard(
        "lone voxel",
        "seen from near by, 10^5 voxels from the rest of the grid",
        lone_voxel,
        extinction=400,
        position=(100_000 / SIDE - 0.5, -0.45, -0.35),
        look_at=(100_000 / SIDE - 0.5, -0.5, -0.5),
    ),
    Hazard("g = 0.999", "nearly all light goes straight on", ball, anisotropy=0.999),
    Hazard("g = -0.999", "nearly all light comes straight back", ball, anisotropy=-0.999),
    Hazard(
        "closed and white",
        "albedo exactly 1, the camera amid 120 mean free paths on each side",
        cube,
        extinction=240,
        anisotropy=0.0,
        position=(0.0, 0.0, 0.0),
        look_at=(0.0, 0.0, -1.0),
        fov=60,
        dear=64,
    ),
    Hazard(
        "bound on work",
        "the same amid 3,000 mean free paths: no path gets out within 2^20 events",
        lambda: cube(1e6, 8),
        voxel=(1 / 8,) * 3,
        anisotropy=0.0,
        position=(0.0, 0.0, 0.0),
        look_at=(0.0, 0.0, -1.0),
        size=(2, 1),
        dear=1 << 17,
    ),
    Hazard("looks", "a, b and c at 0, b below a, b above a", ball, looks=ZERO_LOOKS),
    Hazard(
        "into the sun",
        "a sun of no size, seen straight through the cloud",
        ball,
        extinction=3,
        anisotropy=0.95,
        position=(0.0, 0.0, 2.1),
        lights=straight_sun,
    ),
    Hazard("pin sun", "a sun of 10^-20 degrees", ball, lights=pin_sun),
    Hazard("sky with a spike", "one pixel of 10^6 in a dome of 0.1", ball, lights=spiked_sky),
    Hazard(
        "camera on the edge",
        "exactly on a face of the grid's box, looking along it",
        cube,
        position=(-0.5, -0.5, -0.5 - 1 / SIDE),
        look_at=(-0.5, -0.5, 1.0),
        fov=60,
    ),
    Hazard(
        "camera inside",
        "in the middle of the ball",
        ball,
        position=(0.0, 0.0, 0.0),
        look_at=(0.3, 0.1, 1.0),
    ),
    Hazard(
        "far from the origin",
        "camera and volume 10^6 units away",
        ball,
        origin=(FAR - 0.5, FAR - 0.5, FAR - 0.5),
        position=(FAR + 0.5, FAR + 0.4, FAR + 2.1),
        look_at=(FAR, FAR, FAR),
    ),
    Hazard(
        "far camera",
        "10^6 units from the volume, with a lens to match",
        ball,
        position=(0.0, 0.0, FAR),
        fov=8e-5,
    ),
    Hazard(
        "flat voxels",
        "100 times as long as they are wide",
        slab,
        voxel=(1 / SIDE, 1 / SIDE, 100 / SIDE),
        origin=(-0.5, -0.5, -1.5),
        position=(2.0, 1.5, 6.0),
        look_at=(0.0, 0.0, 0.0),
    ),
    Hazard("NaN and Inf", "three voxels of seven are NaN, infinite or negative", damaged),
    Hazard("1x1 image", "one pixel", ball, size=(1, 1)),
    Hazard("wide bucket", "16,384 pixels by 1", ball, size=(16384, 1)),
    Hazard("one sample", "no variance to be had", ball, samples=1),
)
