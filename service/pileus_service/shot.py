"""The shot: what a user asks for, one model for the file, the HTTP body and the job on disk."""

import difflib
import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, Literal, Self, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    field_validator,
    model_validator,
)

from pileus_service.frames import expand, has_pattern, parse_frames

# Strict: a file's "12" or true is no number, and was hardly meant as one.
Number = Annotated[float, Field(strict=True)]
Whole = Annotated[int, Field(strict=True)]
Flag = Annotated[bool, Field(strict=True)]
Vec3 = tuple[Number, Number, Number]
Method = Literal["single", "contrast", "multiple", "density", "reference", "similarity", "auto"]
Unit = Annotated[Number, Field(ge=0, le=1)]
Radiance = Annotated[Number, Field(ge=0, le=1e6)]
Colour = tuple[Radiance, Radiance, Radiance]
FilePath = Annotated[str, Field(min_length=1, max_length=1024, pattern=r"^[^\x00-\x1f]+$")]

MAX_PIXELS = 1 << 27
MAX_VALUES = 1 << 32
MAX_ORDERS = 64
UNLIMITED = ("reference", "similarity", "auto")  # without max_bounces


class Model(BaseModel):
    """Strict about keys: an unknown one is an error that names the nearest known."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:
        if isinstance(data, dict):
            for key in data:
                if key not in cls.model_fields:
                    near = difflib.get_close_matches(str(key), cls.model_fields, n=1)
                    hint = f"did you mean {near[0]!r}?" if near else "remove it;"
                    known = ", ".join(cls.model_fields)
                    raise ValueError(f"unknown key {str(key)!r:.80}: {hint} known: {known}")
        return data


class Image(Model):
    """The picture's size, place and channels."""

    width: Whole = Field(ge=1, le=65536)
    height: Whole = Field(ge=1, le=65536)
    output: FilePath
    pixel_type: Literal["float", "half"] = "float"
    orders: Flag = False
    background: Flag = True
    denoise: Flag = False

    @field_validator("output")
    @classmethod
    def _is_exr(cls, output: str) -> str:
        if not output.lower().endswith(".exr"):
            raise ValueError("must end in .exr")
        return output

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        if self.width * self.height > MAX_PIXELS:
            raise ValueError(f"width x height is over {MAX_PIXELS} pixels; make it smaller")
        return self


class Volume(Model):
    """A cache and how its grid scatters light."""

    cache: FilePath
    density: str = Field(default="density", max_length=256)
    extinction: Number = Field(ge=0, le=1e9)
    albedo: tuple[Unit, Unit, Unit] = (1.0, 1.0, 1.0)
    anisotropy: Number = Field(default=0.0, gt=-1, lt=1)


Value = TypeVar("Value", float, Vec3)


class Key(Model, Generic[Value]):
    """A value at a frame."""

    frame: Number
    value: Value


def _constant_or_keyed(data: Any) -> str:
    first = data[0] if isinstance(data, list | tuple) and data else data
    return "keyed" if isinstance(first, dict | Key) else "constant"


_Keys = Field(min_length=1, max_length=10_000)
AnimatedVector = Annotated[
    Annotated[Vec3, Tag("constant")] | Annotated[list[Key[Vec3]], _Keys, Tag("keyed")],
    Discriminator(_constant_or_keyed),
]
AnimatedNumber = Annotated[
    Annotated[Number, Tag("constant")] | Annotated[list[Key[Number]], _Keys, Tag("keyed")],
    Discriminator(_constant_or_keyed),
]


class Pose(Model):
    """The camera at one frame."""

    position: Vec3
    look_at: Vec3
    up: Vec3
    fov: float


class Camera(Model):
    """Perspective; each value constant or keyed by frame, linear between keys."""

    position: AnimatedVector
    look_at: AnimatedVector
    up: AnimatedVector = (0.0, 1.0, 0.0)
    fov: AnimatedNumber = 35.0

    def at(self, frame: int) -> Pose:
        return Pose(
            position=_vector_at(self.position, frame),
            look_at=_vector_at(self.look_at, frame),
            up=_vector_at(self.up, frame),
            fov=_number_at(self.fov, frame),
        )

    @field_validator("position", "look_at", "up", "fov")
    @classmethod
    def _rising(cls, value: Any) -> Any:
        if isinstance(value, list):
            frames = [key.frame for key in value]
            if any(b <= a for a, b in pairwise(frames)):
                raise ValueError("the keys' frames must rise")
        return value

    @field_validator("fov")
    @classmethod
    def _opens(cls, fov: Any) -> Any:
        for value in [key.value for key in fov] if isinstance(fov, list) else [fov]:
            if not 0 < value < 180:
                raise ValueError("must lie between 0 and 180 degrees")
        return fov

    @model_validator(mode="after")
    def _looks_somewhere(self) -> Self:
        if not self._moves and not self._sees_at(0):
            raise ValueError("position, look_at and up span no view; part them")
        return self

    def first_blind(self, frames: Iterable[int]) -> int | None:
        """The first of the frames at which a camera that moves has nothing to look along."""
        if not self._moves:
            return None
        return next((frame for frame in frames if not self._sees_at(frame)), None)

    @property
    def _moves(self) -> bool:
        return any(isinstance(v, list) for v in (self.position, self.look_at, self.up))

    def _sees_at(self, frame: int) -> bool:
        pose = self.at(frame)
        ahead = tuple(b - a for a, b in zip(pose.position, pose.look_at, strict=True))
        return _length(_cross(ahead, pose.up)) > 1e-9 * _length(ahead) * _length(pose.up)


class DistantLight(Model):
    """Sun-like: parallel light, or from a small disc where it has an angle."""

    type: Literal["distant"]
    direction: Vec3
    irradiance: Colour
    angle: Number = Field(default=0.0, ge=0, le=180)

    @field_validator("direction")
    @classmethod
    def _goes_somewhere(cls, direction: Vec3) -> Vec3:
        if _length(direction) == 0:
            raise ValueError("must not be zero; give the way the light travels")
        return direction


class DomeLight(Model):
    """Light from all around, times a lat-long texture where one is given."""

    type: Literal["dome"]
    radiance: Colour
    texture: FilePath | None = None


Light = Annotated[DistantLight | DomeLight, Field(discriminator="type")]


class Look(Model):
    """Eq. 1's art direction: attenuation, contribution and phase factors per order."""

    name: str = Field(default="beauty", pattern=r"^[A-Za-z0-9_-]{1,64}$")
    a: Unit = 1.0
    b: Unit = 1.0
    c: Unit = 1.0


class Transport(Model):
    """The method, its depth and its looks."""

    method: Method = "multiple"
    max_bounces: Whole | None = Field(default=None, ge=1, le=65536)
    reduce_from: Whole = Field(default=3, ge=1, le=1024)
    looks: tuple[Look, ...] = Field(default=(Look(),), min_length=1, max_length=16)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        names = [look.name for look in self.looks]
        if len(set(names)) != len(names):
            raise ValueError("two looks have one name; name each for itself")
        if self.method == "single" and self.max_bounces not in (None, 1):
            raise ValueError("single has one order; leave max_bounces out or take another method")
        return self


class Sampling(Model):
    """How many samples a pixel takes, and which; with a tolerance, the most it may take."""

    samples: Whole = Field(ge=1, le=1 << 20)
    seed: Whole = Field(default=0, ge=0, lt=1 << 32)
    tolerance: Number | None = Field(default=None, ge=1e-4, le=1)


class Shot(Model):
    """All that a shot is; a job is one of these and a priority."""

    name: str = Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f]+$")
    frames: str = Field(max_length=10_000)
    fps: Number = Field(default=24.0, gt=0, le=100_000)
    image: Image
    # One for now; a list, so that several can come without a new file format.
    volumes: tuple[Volume, ...] = Field(min_length=1, max_length=1)
    camera: Camera
    lights: tuple[Light, ...] = Field(default=(), max_length=64)
    transport: Transport = Transport()
    sampling: Sampling

    _NEEDS_DEPTH: ClassVar[str] = "orders need an end; give transport.max_bounces, at most 64"

    @field_validator("frames", mode="before")
    @classmethod
    def _single_frame(cls, frames: Any) -> Any:
        return str(frames) if isinstance(frames, int) and not isinstance(frames, bool) else frames

    @field_validator("frames")
    @classmethod
    def _are_frames(cls, frames: str) -> str:
        parse_frames(frames)
        return frames

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if len(self.frame_numbers) > 1 and not has_pattern(self.image.output):
            raise ValueError(
                f"image.output = {self.image.output!r}: every frame would write this one file; "
                "put #### into the file's name for the frame's number"
            )
        self._check_memory()
        if self.transport.method == "auto" and self.sampling.tolerance is None:
            raise ValueError("transport.method auto needs a goal; give sampling.tolerance, as 0.05")
        bounces = self.transport.max_bounces
        unlimited = bounces is None and self.transport.method in UNLIMITED
        if self.image.orders and (unlimited or (bounces or 0) > MAX_ORDERS):
            raise ValueError(f"image.orders: {self._NEEDS_DEPTH}")
        return self

    def _check_memory(self) -> None:
        """Refuses an image that no machine could hold: all layers of it are merged in memory."""
        orders = (self.transport.max_bounces or MAX_ORDERS) if self.image.orders else 0
        layers = len(self.transport.looks) * (8 + 3 * orders)
        if self.image.width * self.image.height * layers > MAX_VALUES:
            raise ValueError(
                f"image: {layers} layers of {self.image.width} x {self.image.height} are over "
                f"{MAX_VALUES} values; take fewer pixels, looks or orders"
            )

    @property
    def frame_numbers(self) -> tuple[int, ...]:
        return parse_frames(self.frames)

    def warnings(self) -> list[str]:
        """What is allowed and seldom meant."""
        if self.transport.method != "contrast":
            return []
        return [
            f"transport.looks.{index}.b = 1: the octaves of contrast add up without end and "
            "brighten with max_bounces; take b below 1"
            for index, look in enumerate(self.transport.looks)
            if look.b == 1
        ]

    def anchored(self, folder: Path) -> "Shot":
        """The same shot with every path absolute, relative ones taken from the folder."""
        return self.with_paths(lambda path: str(folder / path))

    def with_paths(self, change: Callable[[str], str]) -> "Shot":
        """The same shot with every path changed."""
        return self.model_copy(
            update={
                "image": self.image.model_copy(update={"output": change(self.image.output)}),
                "volumes": tuple(
                    volume.model_copy(update={"cache": change(volume.cache)})
                    for volume in self.volumes
                ),
                "lights": tuple(
                    light.model_copy(update={"texture": change(light.texture)})
                    if isinstance(light, DomeLight) and light.texture
                    else light
                    for light in self.lights
                ),
            }
        )

    def output(self, frame: int) -> Path:
        return Path(expand(self.image.output, frame))

    def inputs(self, frame: int) -> Iterator[tuple[str, Path]]:
        """Each file that a frame reads, with the field that names it."""
        for index, volume in enumerate(self.volumes):
            yield f"volumes.{index}.cache", Path(expand(volume.cache, frame))
        for index, light in enumerate(self.lights):
            if isinstance(light, DomeLight) and light.texture:
                yield f"lights.{index}.texture", Path(expand(light.texture, frame))


def _vector_at(value: Vec3 | list[Key[Vec3]], frame: int) -> Vec3:
    if not isinstance(value, list):
        return value
    before, after, weight = _around(value, frame)
    x, y, z = (a + (b - a) * weight for a, b in zip(before.value, after.value, strict=True))
    return x, y, z


def _number_at(value: float | list[Key[float]], frame: int) -> float:
    if not isinstance(value, list):
        return value
    before, after, weight = _around(value, frame)
    return before.value + (after.value - before.value) * weight


def _around(keys: list[Key[Value]], frame: int) -> tuple[Key[Value], Key[Value], float]:
    """The keys about a frame and how far it lies between them; the ends hold."""
    index = bisect_left(keys, float(frame), key=lambda key: key.frame)
    if index in (0, len(keys)):
        end = keys[min(index, len(keys) - 1)]
        return end, end, 0.0
    before, after = keys[index - 1], keys[index]
    return before, after, (frame - before.frame) / (after.frame - before.frame)


def _cross(u: tuple[float, ...], v: tuple[float, ...]) -> tuple[float, float, float]:
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


def _length(v: tuple[float, ...]) -> float:
    return math.hypot(*v)
