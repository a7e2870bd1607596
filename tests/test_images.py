"""What an image holds beside its colours is true of the picture; read by OpenEXR's own module."""

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pileus_core as core
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from pileus_service.shot import Shot
from pileus_worker.commands.render import app

CENTRE, RADIUS = np.array([0.31, -0.17, 0.4]), 0.1


@pytest.fixture
def ball(tmp_path: Path, shot: dict[str, Any]) -> Shot:
    """A small thick ball beside the middle of the view, seen by a tilted camera that moves."""
    voxel, side = RADIUS / 8, 20
    index = np.indices((side, side, side)) - (side - 1) / 2
    inside = (np.linalg.norm(index, axis=0) <= 8).astype(np.float32)
    path = tmp_path / "caches" / "ball.vdb"
    path.parent.mkdir()
    low = CENTRE - voxel * (side - 1) / 2
    core.write_grid(str(path), [((0, 0, 0), inside)], voxel=(voxel,) * 3, origin=tuple(low))
    position = [{"frame": 1, "value": [0, 0, 2]}, {"frame": 3, "value": [1.2, 0.7, 1.5]}]
    return Shot.model_validate(
        shot
        | {
            "image": shot["image"] | {"width": 120, "height": 80},
            "volumes": [{"cache": str(path), "extinction": 1000.0}],
            "camera": {"position": position, "look_at": [0, 0.1, 0], "up": [0.2, 1, 0], "fov": 50},
        }
    )


def rendered(shot: Shot, folder: Path, frame: int) -> tuple[dict[str, Any], NDArray[np.float32]]:
    """An image's header, and its channels R, G, B, A, Z of shape (5, rows, columns)."""
    file = folder / "shot.json"
    file.write_text(shot.model_dump_json())
    ended = CliRunner().invoke(app, [str(file), "--frames", str(frame)])
    assert ended.exit_code == 0, ended.output
    [path] = (folder / "out").iterdir()
    with OpenEXR.File(str(path), separate_channels=True) as image:
        channels = image.channels()
        return dict(image.header()), np.array([channels[name].pixels for name in "RGBAZ"])


@pytest.mark.parametrize("frame", [1, 2, 3])
def test_matrices_and_depth_say_where_things_are(ball: Shot, tmp_path: Path, frame: int) -> None:
    header, (_, _, _, alpha, depth) = rendered(ball, tmp_path, frame)
    here = np.array([*CENTRE, 1.0])
    camera = here @ np.array(header["worldToCamera"])
    x, y, _, w = here @ np.array(header["worldToNDC"])
    rows, columns = np.indices(alpha.shape) + 0.5
    seen = np.array([(columns * alpha).sum(), (rows * alpha).sum()]) / alpha.sum()
    told = np.array([x / w * alpha.shape[1], y / w * alpha.shape[0]])
    # Perspective shifts the middle of a ball's outline by a part of its size.
    assert seen == pytest.approx(told, abs=0.4)
    assert w == pytest.approx(camera[2])
    # Light meets a thick ball at its near side: by how far it sticks out there.
    row, column = told[::-1].astype(int)
    towards = camera[:3] * (1 - RADIUS / np.linalg.norm(camera[:3]))
    assert depth[row, column] == pytest.approx(towards[2], abs=0.15 * RADIUS)
    assert alpha[row, column] == pytest.approx(1.0)
    assert alpha[0, 0] == depth[0, 0] == 0.0


@pytest.mark.parametrize(
    ("fps", "rate"),
    [(23.976, (24000, 1001)), (29.97, (30000, 1001)), (12.5, (25, 2)), (24.0, (24, 1))],
)
def test_the_header_tells_how_the_image_came_to_be(
    ball: Shot, tmp_path: Path, fps: float, rate: tuple[int, int]
) -> None:
    ball = ball.model_copy(update={"fps": fps})
    header, _ = rendered(ball, tmp_path, 2)
    assert header["framesPerSecond"] == Fraction(*rate)
    asked = ball.model_copy(update={"frames": "2"})
    assert Shot.model_validate_json(header["pileus.shot"]) == asked
    assert json.loads(header["pileus.transport"])["method"] == "multiple"
    assert header["software"] == f"Pileus {core.__version__}"
    assert header["renderTime"] > 0
    assert header["pileus.frame"] == "2"
