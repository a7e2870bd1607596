"""The scenes: shot files, the caches that `caches.toml` says how to get, a frame made ready."""

import hashlib
import json
import os
import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pileus_core as core
from numpy.typing import NDArray
from pileus_core import _core
from pydantic import BaseModel, ConfigDict, model_validator

from pileus_service.frames import expand
from pileus_service.shot import DistantLight, Shot
from pileus_service.shotfile import parse_shot
from pileus_worker.scene import cache_path

SCENES = Path(__file__).parent / "scenes"
SHARED = Path("../shared/data")  # real caches, where there are any


def cache_folder() -> Path:
    """Where made caches and truths are kept."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "pileus" / "chart"


class Recipe(BaseModel):
    """Where a cache comes from: made by `pileus make`, or a file that may be absent."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    make: Literal["cloud", "whitewater"] | None = None
    frames: int = 24
    resolution: int = 128
    seed: int = 0
    file: str | None = None
    voxel: float | None = None  # its side in world units, for a file

    @model_validator(mode="after")
    def _one_source(self) -> "Recipe":
        if (self.make is None) == (self.file is None):
            raise ValueError("give either make or file")
        if (self.file is None) != (self.voxel is None):
            raise ValueError("a file, and only a file, needs its voxel")
        return self

    @property
    def side(self) -> float:
        """Of a voxel, in world units."""
        return self.voxel or 1 / self.resolution


class AbsentError(Exception):
    """A scene cannot be shown here; the reason is one line."""


@dataclass(frozen=True)
class BenchScene:
    """A shot whose caches are on disk, scaled to the size that is asked."""

    name: str
    shot: Shot
    voxel: float

    @property
    def frames(self) -> tuple[int, ...]:
        return self.shot.frame_numbers


def scene_names() -> list[str]:
    return sorted(file.stem for file in SCENES.glob("*.toml") if file.stem != "caches")


def load_scene(
    name: str, scale: float, data: Path, shared: Path, resolution: int | None = None
) -> BenchScene:
    """Reads a scene and makes its caches, at a resolution of their own where one is asked.

    Raises AbsentError, or InputError for a bad file.
    """
    file = SCENES / f"{name}.toml"
    written = tomllib.loads(file.read_text())
    image = written["image"]
    for side in ("width", "height"):
        image[side] = max(8, round(image[side] * scale / 8) * 8)
    shot = parse_shot(written, str(file)).anchored(data)
    volume = shot.volumes[0]
    stem = Path(volume.cache).name.split(".")[0]
    recipes = tomllib.loads((SCENES / "caches.toml").read_text())
    recipe = Recipe.model_validate(recipes[stem])
    if resolution is not None:
        recipe = recipe.model_copy(update={"resolution": resolution})
    if recipe.file is not None:
        found = (shared / recipe.file).resolve()
        if not Path(expand(str(found), shot.frame_numbers[0])).is_file():
            raise AbsentError(f"{name}: skipped, needs {recipe.file} in {shared}")
        volume = volume.model_copy(update={"cache": str(found)})
        shot = shot.model_copy(update={"volumes": (volume,)})
    else:
        _make(recipe, shot)
    return BenchScene(name, shot, recipe.side)


def _make(recipe: Recipe, shot: Shot) -> None:
    """Makes the frames that are wanted; one of another recipe or maker is made again."""
    write = core.make_cloud if recipe.make == "cloud" else core.make_whitewater
    stamp = json.dumps([recipe.model_dump(), _maker()])
    for frame in shot.frame_numbers:
        path = cache_path(shot, frame)
        note = path.with_suffix(".recipe")
        if path.is_file() and note.is_file() and note.read_text() == stamp:
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        write(
            str(path),
            frame=frame,
            frames=recipe.frames,
            resolution=recipe.resolution,
            seed=recipe.seed,
        )
        note.write_text(stamp)


@cache
def _maker() -> str:
    """What tells one build of the core from another."""
    return hashlib.sha256(Path(_core.__file__).read_bytes()).hexdigest()


def view_of(scene: BenchScene, frame: int, data: Path) -> dict[str, Any]:
    """One frame as a renderer's process reads it: plain values, world units, degrees.

    `voxels` is the grid as a dense array of shape (z, y, x), for renderers that read no VDB.
    """
    shot = scene.shot
    medium, pose, cache = shot.volumes[0], shot.camera.at(frame), cache_path(shot, frame)
    volume = core.Volume(str(cache), medium.density)
    bounds = volume.world_bounds
    if bounds is None:
        raise AbsentError(f"{scene.name}: skipped, frame {frame} of its cache is empty")
    low, high = bounds
    file = data / "voxels" / f"{scene.name}.{frame:04d}.{scene.voxel:g}.npy"
    if not file.is_file() or file.stat().st_mtime < cache.stat().st_mtime:
        file.parent.mkdir(parents=True, exist_ok=True)
        np.save(file, dense(volume, scene.voxel))
    index_to_world = np.diag([scene.voxel, scene.voxel, scene.voxel, 1.0])
    index_to_world[3, :3] = low
    return {
        "shot": shot.model_dump(mode="json"),
        "frame": frame,
        "cache": str(cache),
        "grid": medium.density,
        "voxels": str(file),
        "index_to_world": index_to_world.flatten().tolist(),
        "extinction": medium.extinction,
        "albedo": medium.albedo,
        "anisotropy": medium.anisotropy,
        "camera": pose.model_dump(),
        "inside": all(a < x < b for a, x, b in zip(low, pose.position, high, strict=True)),
        "lights": [_light(light) for light in shot.lights],
        "width": shot.image.width,
        "height": shot.image.height,
    }


def dense(volume: core.Volume, voxel: float) -> NDArray[np.float32]:
    """A volume that is not empty and lies along the axes as an array of shape (z, y, x).

    Its voxels are those that Pileus interpolates, from the lower corner of the world's box on.
    """
    low, high = (np.asarray(corner) for corner in volume.world_bounds or ((0,) * 3, (0,) * 3))
    counts = np.rint((high - low) / voxel).astype(int) + 1
    xs, ys, zs = (low[axis] + voxel * np.arange(counts[axis]) for axis in range(3))
    at = volume.interpolate
    values = (at((x, y, z)) for z in zs for y in ys for x in xs)
    return np.fromiter(values, np.float32, int(counts.prod())).reshape(counts[::-1])


def _light(light: Any) -> dict[str, Any]:
    if isinstance(light, DistantLight):
        return {
            "type": "distant",
            "direction": light.direction,
            "irradiance": light.irradiance,
            "angle": light.angle,
        }
    return {"type": "dome", "radiance": light.radiance}
