"""Skies from image files: what a file's channels mean, and which images are none."""

import struct
from pathlib import Path

import numpy as np
import pileus_core as core
import pytest
from numpy.typing import NDArray
from PIL import Image


def seen(texture: Path, folder: Path) -> NDArray[np.float32]:
    """The RGB that a camera sees of a sky where no volume is."""
    nothing = folder / "nothing.vdb"
    core.write_grid(str(nothing), [((0, 0, 0), np.zeros((2, 2, 2), np.float32))])
    scene = core.Scene(
        volume=core.Volume(str(nothing)),
        extinction=1.0,
        albedo=(1.0, 1.0, 1.0),
        anisotropy=0.0,
        camera=core.Camera(position=(0, 0, 0), look_at=(0, 0, 1), up=(0, 1, 0), fov=20.0),
        lights=[core.DomeLight(radiance=(1.0, 2.0, 4.0), texture=str(texture))],
        width=1,
        height=1,
    )
    transport = core.Transport(method="single", looks=[core.Look(name="a")])
    found = core.render(
        scene, transport, bucket=(0, 0, 1, 1), samples=(0, 1), seed=1, frame=1, threads=1
    )
    return found.pixels(found.looks[0])[0, 0, :3]


@pytest.mark.parametrize(
    ("mode", "value"), [("L", (51,)), ("LA", (51, 255)), ("RGBA", (51, 51, 51, 255))]
)
def test_grey_is_grey_and_alpha_is_no_light(
    mode: str, value: tuple[int, ...], tmp_path: Path
) -> None:
    texture = tmp_path / "sky.png"
    Image.new(mode, (8, 4), value).save(texture)
    np.testing.assert_allclose(seen(texture, tmp_path), (0.2, 0.4, 0.8), rtol=1e-5)


def test_a_volume_of_pixels_is_no_sky(tmp_path: Path) -> None:
    """It has a slice for every depth; a sky's memory is that of one."""
    side, depth = 16, 64
    flags, caps, volume = 0x80100F, 0x1008, 0x200000
    header = struct.pack("<4s7I44x", b"DDS ", 124, flags, side, side, side * 4, depth, 0)
    pixel = struct.pack("<8I", 32, 0x41, 0, 32, 0xFF, 0xFF00, 0xFF0000, 0xFF000000)
    texture = tmp_path / "sky.dds"
    texture.write_bytes(
        header + pixel + struct.pack("<5I", caps, volume, 0, 0, 0) + bytes(side * side * depth * 4)
    )
    with pytest.raises(core.InputError, match=r"sky\.dds: is a volume"):
        core.DomeLight(radiance=(1.0, 1.0, 1.0), texture=str(texture))
