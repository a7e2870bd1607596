"""The guards that hold for every method, whatever the scene."""

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pileus_core as core
import pytest
from pydantic import ValidationError

from pileus_service.shot import Shot
from stability.battery import FULL, METHODS, SMALL, Detail, Stage, faults, run
from stability.hazards import BEAUTY, HAZARDS, SIDE, Hazard, ball, damaged

BY_NAME = {hazard.name: hazard for hazard in HAZARDS}


@pytest.mark.parametrize("hazard", HAZARDS, ids=lambda hazard: hazard.name)
@pytest.mark.parametrize(
    "detail",
    [pytest.param(SMALL, id="small"), pytest.param(FULL, id="full", marks=pytest.mark.slow)],
)
def test_every_guard_holds_with_every_method(
    hazard: Hazard, detail: Detail, tmp_path: Path
) -> None:
    stage = Stage.of(hazard, tmp_path, detail)
    broken = {method: run(stage, method).broken for method in METHODS}
    assert not {method: guards for method, guards in broken.items() if guards}


def test_the_bound_on_work_is_counted_and_told(tmp_path: Path) -> None:
    """Both paths start so deep that they cannot get out within 2^20 events."""
    hazard = BY_NAME["bound on work"]
    hazard.volume(tmp_path)
    shot = {
        "name": "bound",
        "frames": "1",
        "image": {"width": 2, "height": 1, "output": "bound.exr"},
        "volumes": [{"cache": "hazard.vdb", "extinction": hazard.extinction}],
        "camera": {"position": hazard.position, "look_at": hazard.look_at},
        "lights": [{"type": "dome", "radiance": [1.0, 1.0, 1.0]}],
        "transport": {"method": "reference"},
        "sampling": {"samples": 1},
    }
    (tmp_path / "bound.json").write_text(json.dumps(shot))
    pileus = str(Path(sys.executable).with_name("pileus"))
    ended = subprocess.run(
        [pileus, "render", "bound.json", "--json"], cwd=tmp_path, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stderr
    [frame] = json.loads(ended.stdout)["frames"]
    assert frame["bounded_paths"] == 2
    assert "2 paths met the bound" in ended.stderr
    # An EXR string attribute: its name, its type, its length, its value.
    told = b"pileus.boundedPaths\0string\0" + (1).to_bytes(4, "little") + b"2"
    assert told in (tmp_path / "bound.exr").read_bytes()


@pytest.mark.parametrize("method", core.METHODS)
def test_samples_up_to_a_million_add_up_in_ranges(method: str, tmp_path: Path) -> None:
    """The last samples of 2^20, in ranges, are those of one range; none is like another."""
    stage = Stage.of(BY_NAME["1x1 image"], tmp_path, SMALL)
    last, parts = 1 << 20, 4
    first = last - 256
    whole = stage.render(method, (first, last))
    assert not faults(whole.channels(BEAUTY), 256)
    step = (last - first) // parts
    ranges = [
        stage.render(method, (first + i * step, first + (i + 1) * step)) for i in range(parts)
    ]
    values = [float(part.channels(BEAUTY)["G"][0, 0]) for part in ranges]
    assert len(set(values)) == parts
    assert np.mean(values) == pytest.approx(float(whole.channels(BEAUTY)["G"][0, 0]), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("method", core.METHODS)
def test_a_million_samples_merge_into_one_pixel(method: str, tmp_path: Path) -> None:
    """Ranges of 2^18 give the image of all 2^20 at once, its variance too."""
    stage = Stage.of(BY_NAME["1x1 image"], tmp_path, SMALL)
    last, step = 1 << 20, 1 << 18
    merged = core.Frame(1, 1, [((0, 0, 1, 1), last)])
    for first in range(0, last, step):
        merged.add(stage.render(method, (first, first + step)))
    whole = stage.render(method, (0, last)).channels(BEAUTY)
    for channel, value in zip("RGBA", merged.pixels(BEAUTY)[0, 0], strict=True):
        assert value == pytest.approx(float(whole[channel][0, 0]), rel=1e-6)


def test_what_no_density_can_be_is_counted(tmp_path: Path) -> None:
    ((_, values),) = damaged()
    volume = BY_NAME["NaN and Inf"].volume(tmp_path)
    told = " ".join(volume.warnings)
    for count, what in (
        (np.isnan(values).sum(), "NaN"),
        (np.isinf(values).sum(), "infinite"),
        ((values < 0).sum(), "negative"),
    ):
        assert f"has {count} {what} voxels; taken as 0" in told


def test_a_grid_needs_memory_for_what_it_stores_not_for_where(tmp_path: Path) -> None:
    """1 KiB a brick of 8^3 voxels, 4 KiB a node: the formula of docs/stability.md."""
    path = tmp_path / "ball.vdb"
    core.write_grid(str(path), ball())
    near = core.Volume(str(path))
    far = BY_NAME["lone voxel"].volume(tmp_path)
    bricks, levels = (SIDE // 8) ** 3, math.ceil(math.log(100_000 + 16, 8)) - 1
    assert near.bytes < 1024 * bricks + 4096 * 8 * 2 + 1024
    # One brick more, and at each level the nodes around both places.
    assert far.bytes - near.bytes < 1024 + 4096 * 8 * 2 * levels


def added(hazard: str, size: tuple[int, int], rendered: str) -> int:
    """Bytes that a render adds at most to what is held before it, in a process alone."""
    program = f"""
import re, tempfile
from pathlib import Path
from stability.battery import SMALL, Stage
from stability.hazards import HAZARDS
from dataclasses import replace
from pileus_service.shot import Look
def memory(name):  # bytes; getrusage's maximum would be that of the parent at first
    return 1024 * int(re.search(name + ":\\s*(\\d+)", Path("/proc/self/status").read_text())[1])
hazard = replace(next(h for h in HAZARDS if h.name == "{hazard}"), size={size})
with tempfile.TemporaryDirectory() as folder:
    stage = Stage.of(hazard, Path(folder), SMALL)
    held = memory("VmRSS")
    partial = stage.render({rendered})
    print(memory("VmHWM") - held)
"""
    ended = subprocess.run(
        [sys.executable, "-c", program],
        cwd=Path(__file__).parents[1],
        env={"PYTHONPATH": "."},
        capture_output=True,
        text=True,
        check=True,
    )
    return int(ended.stdout)


def test_an_image_needs_memory_for_its_pixels() -> None:
    """4 bytes a pixel, look and channel: the formula of docs/stability.md."""
    width, height, looks, channels = 16384, 96, 4, 8
    named = f'[Look(name=f"look{{i}}") for i in range({looks})]'
    held = added("wide bucket", (width, height), f'"single", (0, 1), looks={named}, lights=[]')
    assert held == pytest.approx(4 * width * height * looks * channels, abs=24e6)


def test_rays_in_flight_need_bounded_memory() -> None:
    """600 bytes for each light, look and order: the formula of docs/stability.md. A path in flight
    holds a shadow ray for each; 256 of them at once would hold gigabytes."""
    octaves = 1 << 16
    look = '[Look(name="look", a=0.999, b=0.9, c=0.9)]'
    held = added("looks", (8, 6), f'"contrast", (0, 4), looks={look}, max_bounces={octaves}')
    assert held < 2 * 600 * octaves


def refused(what: str, call: Any) -> None:
    with pytest.raises(core.InputError, match=what):
        call()


@pytest.mark.parametrize("value", [-0.1, 1.001, 1e30, math.nan, math.inf])
@pytest.mark.parametrize("letter", ["a", "b", "c"])
def test_looks_outside_their_range_are_refused(
    letter: str, value: float, shot: dict[str, Any]
) -> None:
    """b > 1 diverges, c > 1 is no phase function, a > 1 has no majorant."""
    look = core.Look(name="look", **{letter: value})
    for method in core.METHODS:
        refused("between 0 and 1", lambda m=method: core.Transport(method=m, looks=[look]))
    shot["transport"] = {"looks": [{letter: value}]}
    with pytest.raises(ValidationError, match=rf"looks\.0\.{letter}"):
        Shot.model_validate(shot)


def test_numbers_that_no_float_can_hold_are_refused(tmp_path: Path) -> None:
    huge = (1e300, 0.0, 0.0)
    refused(
        "camera",
        lambda: core.Camera(position=huge, look_at=(0, 0, 0), up=(0, 1, 0), fov=35.0),
    )
    refused("direction", lambda: core.DistantLight(direction=huge, irradiance=(1, 1, 1)))
    for light in (math.inf, math.nan, -1.0, 1e13):
        refused("radiance", lambda v=light: core.DomeLight(radiance=(v, 1.0, 1.0)))
        refused(
            "irradiance",
            lambda v=light: core.DistantLight(direction=(0, 0, 1), irradiance=(v, 1.0, 1.0)),
        )
    path = str(tmp_path / "tiny.vdb")
    for side in (1e-13, 1e13):
        core.write_grid(path, ball(), voxel=(side, 1 / side, 1.0))
        refused("world units wide", lambda p=path: core.Volume(p))
    nearly_one = Hazard("", "", ball, anisotropy=1 - 1e-9)
    stage = Stage.of(nearly_one, tmp_path, SMALL)
    refused("anisotropy", lambda: stage.render("single", (0, 1)))
