"""Files that nobody meant to write: right ones with bytes flipped, cut, repeated and exchanged; and
a process with limits in which to read them as the renderer does."""

import multiprocessing
import random
import resource
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import pileus_core as core

from pileus_service.errors import InputError
from pileus_service.shotfile import load_shot
from render_fixtures import camera_around, make_scene, render

MEMORY = 3 << 30
SECONDS = 60.0
EDGES = [0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 40,
         (1 << 63) - 1, (1 << 64) - 1]  # fmt: skip


def mutated(data: bytes, others: list[bytes], dice: random.Random) -> bytes:
    """A file near the given one; half of the changes fall where headers are."""
    spoiled = bytearray(data)
    for _ in range(dice.choice([1, 1, 2, 4, 16])):
        reach = len(spoiled) if dice.random() < 0.5 else min(len(spoiled), 2048)
        at = dice.randrange(max(1, reach))
        length = min(dice.choice([1, 2, 4, 8, 64, 1024]), len(spoiled) - at)
        match dice.randrange(7):
            case 0:
                for place in range(at, at + min(length, 8)):
                    spoiled[place] ^= 1 << dice.randrange(8)
            case 1:
                width = dice.choice([1, 2, 4, 8])
                edge = dice.choice(EDGES) & ((1 << 8 * width) - 1)
                spoiled[at : at + width] = edge.to_bytes(width, dice.choice(["little", "big"]))
            case 2:
                del spoiled[at : at + length]
            case 3:
                spoiled[at:at] = spoiled[at : at + length]
            case 4:
                spoiled[at : at + length] = dice.randbytes(length)
            case 5:
                other = dice.choice(others)
                begin = dice.randrange(len(other))
                spoiled[at : at + length] = other[begin : begin + length]
            case 6:
                del spoiled[max(at, 16) :]
    return bytes(spoiled)


def read_as_the_renderer_does(path: Path) -> None:
    """Raises the error that a user would see."""
    match path.suffix:
        case ".vdb":
            volume = core.Volume(str(path), "density")
            dome = core.DomeLight(radiance=(1, 1, 1), texture="")
            scene = make_scene(volume, camera_around(volume), [dome], extinction=20.0, size=4)
            for method in ("multiple", "reference"):
                render(scene, method, 1, 4, max_bounces=8)
        case ".exr":
            core.DomeLight(radiance=(1, 1, 1), texture=str(path))
            core.read_image(str(path))
            core.Partial.read(str(path))
        case _:
            load_shot(path)


class Outcome(NamedTuple):
    """`how` is ok, refused, memory, odd, or what ended the process."""

    how: str
    line: str


def _serve(pipe: "Connection[Any, Any]") -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    while True:
        path = pipe.recv()
        try:
            read_as_the_renderer_does(path)
            told = Outcome("ok", "")
        except (core.InputError, InputError) as error:
            told = Outcome("refused", str(error))
        except MemoryError:
            told = Outcome("memory", "")
        except Exception as error:
            told = Outcome("odd", repr(error))
        pipe.send(told)


class Reader:
    """Reads files in a child that is replaced when it dies or hangs."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._child = context.Process(target=_serve, args=(theirs,), daemon=True)
        self._child.start()
        theirs.close()

    def read(self, path: Path) -> Outcome:
        self._pipe.send(path)
        try:
            if self._pipe.poll(SECONDS):
                outcome: Outcome = self._pipe.recv()
                return outcome
            how = "hung"
        except EOFError:
            self._child.join()
            how = f"died of signal {-(self._child.exitcode or 0)}"
        self.close()
        self._start()
        return Outcome(how, "")

    def close(self) -> None:
        self._child.kill()
        self._child.join()
        self._pipe.close()


def seeds(folder: Path) -> dict[str, list[bytes]]:
    """Small right files of each kind, by suffix."""
    caches = []
    for frame in (1, 2):
        path = folder / f"seed.{frame}.vdb"
        core.make_cloud(str(path), frame=frame, frames=2, resolution=12)
        caches.append(path.read_bytes())
    volume = core.Volume(str(path))
    dome = core.DomeLight(radiance=(1, 1, 1), texture="")
    scene = make_scene(volume, camera_around(volume), [dome], extinction=20.0, size=16)
    looks = [core.Look(name="one"), core.Look(name="two", a=0.5, b=0.5, c=0.5)]
    transport = core.Transport(method="multiple", max_bounces=2, looks=looks)
    part = core.render(scene, transport, bucket=(0, 0, 16, 16), samples=(0, 2), seed=1, frame=1)
    part.write(str(folder / "part.exr"), "identity")
    frame_image = core.Frame(16, 16, [((0, 0, 16, 16), 2)])
    frame_image.add(part)
    frame_image.write(str(folder / "frame.exr"), half=True, header={"software": "test"})
    images = [(folder / name).read_bytes() for name in ("part.exr", "frame.exr")]
    examples = Path(__file__).parents[1] / "examples"
    shots = [path.read_bytes() for path in sorted(examples.glob("*.toml"))]
    return {".vdb": caches, ".exr": images, ".toml": shots}


def hostile_files(
    folder: Path, suffix: str, count: int, seed: int, more: Sequence[bytes] = ()
) -> Iterator[tuple[int, Path, bytes]]:
    """Writes mutants one by one under one name; the same seed gives the same files."""
    right = [*seeds(folder)[suffix], *more]
    for number in range(count):
        dice = random.Random(f"{seed}.{suffix}.{number}")
        data = mutated(dice.choice(right), right, dice)
        path = folder / f"mutant{suffix}"
        path.write_bytes(data)
        yield number, path, data
