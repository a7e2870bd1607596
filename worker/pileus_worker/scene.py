"""From a shot and a frame to the renderer's objects, and what an image's header says of them."""

import contextlib
import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from fractions import Fraction
from pathlib import Path

import pileus_core as core

from pileus_service import __version__
from pileus_service.frames import expand
from pileus_service.jobs import Cache, Resolved
from pileus_service.shot import DistantLight, DomeLight, Shot
from pileus_worker.paths import NOWHERE_ELSE, PathMap

Header = dict[str, str | float | tuple[int, int] | list[float]]
# Gives the location at which the renderer is to open a file.
Opener = Callable[[Path], AbstractContextManager[str]]


def as_named(path: Path) -> AbstractContextManager[str]:
    """For who may read whatever a path leads to."""
    return contextlib.nullcontext(str(path))


def cache_path(shot: Shot, frame: int) -> Path:
    return Path(expand(shot.volumes[0].cache, frame))


def files_of(shot: Shot, frame: int, paths: PathMap = NOWHERE_ELSE) -> list[Cache]:
    """What a frame reads as it is on disk now: its cache, then the textures of its lights."""
    return [_on_disk(field, path, paths) for field, path in shot.inputs(frame)]


def cache_of(shot: Shot, frame: int, paths: PathMap = NOWHERE_ELSE) -> Cache:
    """The cache file of a frame as it is on disk now."""
    return _on_disk("volumes.0.cache", cache_path(shot, frame), paths)


def _on_disk(field: str, path: Path, paths: PathMap) -> Cache:
    here = paths.here(str(path))
    try:
        found = Path(here).stat()
    except OSError as error:
        raise core.InputError(f"{field}: {here}: {error.strerror}; mend the path") from None
    return Cache(path=str(path), mtime_ns=found.st_mtime_ns, size=found.st_size)


def make_camera(shot: Shot, frame: int) -> core.Camera:
    pose = shot.camera.at(frame)
    return core.Camera(position=pose.position, look_at=pose.look_at, up=pose.up, fov=pose.fov)


def make_scene(
    shot: Shot,
    frame: int,
    volume: core.Volume,
    reading: Opener = as_named,
    warn: Callable[[str], None] = lambda warning: None,
) -> core.Scene:
    """The renderer's scene; `warn` hears what is odd in the files of it, whose paths are told and
    not the locations at which they were opened."""
    medium = shot.volumes[0]
    for warning in volume.warnings:
        warn(warning.replace(volume.path, str(cache_path(shot, frame)), 1))
    return core.Scene(
        volume=volume,
        extinction=medium.extinction,
        albedo=medium.albedo,
        anisotropy=medium.anisotropy,
        camera=make_camera(shot, frame),
        lights=[_light(light, frame, reading, warn) for light in shot.lights],
        width=shot.image.width,
        height=shot.image.height,
        background=shot.image.background,
    )


def _light(
    light: DistantLight | DomeLight, frame: int, reading: Opener, warn: Callable[[str], None]
) -> core.DistantLight | core.DomeLight:
    if isinstance(light, DistantLight):
        return core.DistantLight(
            direction=light.direction, irradiance=light.irradiance, angle=light.angle
        )
    if light.texture is None:
        return core.DomeLight(radiance=light.radiance, texture="")
    texture = Path(expand(light.texture, frame))
    with reading(texture) as location:
        dome = core.DomeLight(radiance=light.radiance, texture=location)
    for warning in dome.warnings:
        warn(warning.replace(location, str(texture), 1))
    return dome


def make_looks(shot: Shot) -> list[core.Look]:
    return [
        core.Look(name=look.name, a=look.a, b=look.b, c=look.c) for look in shot.transport.looks
    ]


def make_transport(shot: Shot, resolved: Resolved) -> core.Transport:
    return core.Transport(
        method=resolved.method,
        max_bounces=resolved.max_bounces,
        looks=make_looks(shot),
        reduce_from=resolved.reduce_from,
    )


def identity(shot: Shot, frame: int, files: Sequence[Cache]) -> str:
    """A digest of all that a frame's pixels depend on; partials of another are no part of it."""
    unseen = {"output", "pixel_type"}
    if shot.sampling.tolerance is None:
        unseen.add("denoise")  # which else says how many samples are taken
    pixels = {
        "frame": frame,
        "files": [file.model_dump() for file in files],
        "camera": shot.camera.at(frame).model_dump(),
        "image": shot.image.model_dump(exclude=unseen),
        "version": core.__version__,
        **shot.model_dump(mode="json", include={"volumes", "lights", "transport", "sampling"}),
    }
    return hashlib.sha256(json.dumps(pixels, sort_keys=True).encode()).hexdigest()


def header(
    shot: Shot, number: int, resolved: Resolved, seconds: float, frame: core.Frame
) -> Header:
    """What a pipeline wants to know of the image of a frame."""
    camera = make_camera(shot, number)
    rate = Fraction(shot.fps).limit_denominator(1001)
    return {
        "worldToCamera": camera.world_to_camera(),
        "worldToNDC": camera.world_to_ndc(shot.image.width, shot.image.height),
        "framesPerSecond": (rate.numerator, rate.denominator),
        "renderTime": seconds,
        "software": f"Pileus {__version__}",
        "pileus.frame": str(number),
        "pileus.shot": shot.model_dump_json(),
        "pileus.transport": resolved.model_dump_json(),
        "pileus.boundedPaths": str(frame.bounded_paths),
        "pileus.unmetBuckets": str(frame.unmet_buckets),
    }
