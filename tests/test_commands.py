"""The commands that need no farm: what they write, what they refuse, how they end."""

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pileus_core as core
import pytest

from pileus_worker import machine, planning
from pileus_worker.commands.compare import compared

PILEUS = str(Path(sys.executable).with_name("pileus"))


def pileus(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([PILEUS, *map(str, arguments)], capture_output=True, text=True)


def refused(ended: subprocess.CompletedProcess[str]) -> str:
    """The one line of a command that was given wrong input."""
    assert ended.returncode == 2, ended.stderr
    assert ended.stderr.count("\n") == 1
    return ended.stderr


@pytest.fixture
def shot_file(tmp_path: Path, shot: dict[str, Any]) -> Path:
    (tmp_path / "caches").mkdir()
    for frame in (1, 2):
        path = tmp_path / "caches" / f"cloud.{frame:04d}.vdb"
        core.make_cloud(str(path), frame=frame, frames=2, resolution=32)
    file = tmp_path / "shot.json"
    file.write_text(json.dumps({**shot, "frames": "1-2"}))
    return file


def test_render_writes_each_frame_and_reports_it(shot_file: Path, tmp_path: Path) -> None:
    ended = pileus("render", shot_file, "--frames", "2", "--set", "image.orders=true", "--json")
    assert ended.returncode == 0, ended.stderr
    [report] = json.loads(ended.stdout)["frames"]
    assert report.keys() == {
        "frame", "file", "seconds", "load_seconds", "render_seconds",
        "samples", "error", "unmet_buckets", "method", "max_bounces", "reason", "bounded_paths",
        "warnings",
    }  # fmt: skip
    assert (report["frame"], report["samples"], report["max_bounces"]) == (2, 4, 4)
    [channels] = core.read_image(str(tmp_path / "out" / "test.0002.exr")).values()
    expected = {*"RGBAZ", "variance.R", "variance.G", "variance.B"}
    expected |= {f"order{order:02d}.{channel}" for order in range(4) for channel in "RGB"}
    assert channels.keys() == expected
    assert channels["R"].shape == (32, 48)


def test_a_render_does_not_wait_for_what_other_commands_need(shot_file: Path) -> None:
    program = """
import sys
from pileus_service.cli import app
try:
    app()
except SystemExit as ended:
    assert not ended.code
print(*sys.modules)
"""
    command = [sys.executable, "-c", program, "render", str(shot_file), "--frames", "1"]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    loaded = {*ended.stdout.split()}
    assert "pileus_worker.deciding" in loaded
    assert not loaded & {"fastapi", "httpx", "redis", "rich", "structlog", "tenacity", "PIL"}


def test_wrong_input_of_render_is_one_line_and_exit_code_two(
    shot_file: Path, tmp_path: Path
) -> None:
    line = refused(pileus("render", shot_file, "--set", "volumes.0.density=smoke"))
    assert "smoke" in line
    assert "density" in line
    assert "samples = 0" in refused(pileus("render", shot_file, "--set", "sampling.samples=0"))
    assert "gap of 1 of 3" in refused(pileus("render", shot_file, "--frames", "1-3"))
    keys = "[{frame = 1, value = [0, 0, 1]}, {frame = 3, value = [0, 0, -1]}]"
    blind = ("--set", f"camera.position={keys}", "--set", "camera.look_at=[0, 0, 0]")
    assert "no view at frame 2" in refused(pileus("render", shot_file, *blind))
    # A script whose variable is not set meant no frame, least of all each of them.
    for command in ("render", "submit"):
        assert "frames = '': '' is no" in refused(pileus(command, shot_file, "--frames", ""))
    (tmp_path / "file").touch()
    assert "image.output" in refused(pileus("render", shot_file, "--out", tmp_path / "file"))
    (tmp_path / "caches" / "cloud.0001.vdb").write_bytes(b"not a vdb")
    assert "cloud.0001.vdb" in refused(pileus("render", shot_file))


def test_a_data_folder_that_cannot_be_is_one_line_and_exit_code_two(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    data = tmp_path / "file" / "data"
    for command in (["worker"], ["up"], ["service"], ["token", "create", "ann"]):
        assert f"--data {data}: Not a directory" in refused(pileus(*command, "--data", data))


def test_a_service_that_cannot_be_asked_is_one_line_and_exit_code_two(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert "--server http://h:abc" in refused(pileus("list", "--server", "http://h:abc"))
    for token in ("ann.é", "ann.sec\nret"):
        monkeypatch.setenv("PILEUS_TOKEN", token)
        line = refused(pileus("list", "--server", "http://127.0.0.1:1"))
        assert "--token" in line
        assert "ann" not in line


def test_make_writes_a_sequence(tmp_path: Path) -> None:
    out = tmp_path / "new" / "cloud.$F3.vdb"
    ended = pileus("make", "cloud", out, "--frames", "1-2", "--resolution", "32")
    assert ended.returncode == 0, ended.stderr
    for name in ("cloud.001.vdb", "cloud.002.vdb"):
        assert core.Volume(str(tmp_path / "new" / name)).active_voxels > 0
    assert "put ####" in refused(pileus("make", "cloud", tmp_path / "a.vdb", "--frames", "1-2"))

    # A frame made alone is the one of the whole sequence; another length is another action.
    voxels = core.Volume(str(tmp_path / "new" / "cloud.002.vdb")).active_voxels
    for length, same in ((24, True), (2, False)):
        alone = tmp_path / f"alone.{length}.vdb"
        ended = pileus(
            "make", "cloud", alone, "--frames", "2", "--resolution", "32", "--length", f"{length}"
        )
        assert ended.returncode == 0, ended.stderr
        assert (core.Volume(str(alone)).active_voxels == voxels) is same
    assert "greater --length" in refused(
        pileus("make", "cloud", tmp_path / "a.vdb", "--frames", "3", "--length", "2")
    )


def test_making_ends_when_it_is_interrupted(tmp_path: Path) -> None:
    command = [PILEUS, "make", "cloud", str(tmp_path / "c.####.vdb"), "--frames", "1-9"]
    begun = subprocess.Popen(
        [*command, "--resolution", "900"],
        start_new_session=True,
        # A shell has what it starts in the background ignore it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        time.sleep(3)
        os.killpg(begun.pid, signal.SIGINT)  # as a terminal does
        # A frame takes longer, nine of them many minutes.
        assert begun.wait(timeout=60) == 128 + signal.SIGINT
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(begun.pid, signal.SIGKILL)
    assert not list(tmp_path.glob("*.vdb"))


def test_a_cache_that_does_not_fit_on_the_disk_is_not_there_at_all(tmp_path: Path) -> None:
    def full() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20480, 20480))

    command = [PILEUS, "make", "cloud", str(tmp_path / "cloud.vdb"), "--frames", "1"]
    ended = subprocess.run(
        [*command, "--resolution", "64"], capture_output=True, text=True, preexec_fn=full
    )
    assert ended.returncode == 1
    assert ended.stderr.count("\n") == 1
    assert "cannot be written (File too large)" in ended.stderr
    assert not list(tmp_path.iterdir())


def test_compare_tells_the_error_as_it_is_defined(shot_file: Path, tmp_path: Path) -> None:
    image, reference = np.full((2, 2, 3), 0.5), np.full((2, 2, 3), 0.25)
    result = compared(image, reference)
    assert result.rel_mse == pytest.approx(0.25**2 / (0.25**2 + 0.01))
    assert result.mean_ratio == pytest.approx(2.0)
    assert result.largest_error == pytest.approx(0.25)
    assert pileus("render", shot_file).returncode == 0
    first, second = (tmp_path / "out" / f"test.{frame:04d}.exr" for frame in (1, 2))
    same = json.loads(pileus("compare", first, first, "--json").stdout)
    assert same == {"rel_mse": 0.0, "mean_ratio": 1.0, "largest_error": 0.0}
    difference = tmp_path / "difference.png"
    ended = pileus("compare", first, second, "--difference", difference)
    assert ended.stdout.startswith("relMSE ")
    assert difference.read_bytes().startswith(b"\x89PNG")
    assert "nowhere.exr" in refused(pileus("compare", first, tmp_path / "nowhere.exr"))


def test_memory_is_what_the_narrowest_control_group_allows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(machine, "OWN_GROUP", tmp_path / "own")
    monkeypatch.setattr(machine, "GROUPS", tmp_path / "groups")
    unit = tmp_path / "groups" / "system.slice" / "pileus-worker.service"
    unit.mkdir(parents=True)
    (tmp_path / "own").write_text("4:memory:/elsewhere\n0::/system.slice/pileus-worker.service\n")
    whole = machine.memory_bytes()
    (unit / "memory.max").write_text("max\n")
    assert machine.memory_bytes() == whole
    (unit.parent / "memory.max").write_text("1000000\n")
    assert machine.memory_bytes() == 800_000
    (unit / "memory.max").write_text("500000\n")
    assert machine.memory_bytes() == 400_000


@pytest.mark.parametrize("seconds", [1e-4, 0.01, 100.0])
@pytest.mark.parametrize("size", [(48, 32), (130, 70), (512, 512)])
def test_a_plan_covers_each_pixel_with_each_sample_once(
    shot_file: Path, tmp_path: Path, size: tuple[int, int], seconds: float
) -> None:
    volume = core.Volume(str(tmp_path / "caches" / "cloud.0001.vdb"))
    camera = core.Camera(position=(0, 0, 9), look_at=(0, 0, 0), up=(0, 1, 0), fov=30)
    view = core.Scene(
        volume=volume, extinction=9.0, albedo=(1, 1, 1), anisotropy=0.0, camera=camera,
        lights=[], width=size[0], height=size[1],
    )  # fmt: skip
    cell = 64
    columns, rows = -(-size[0] // cell), -(-size[1] // cell)
    cost = planning.Cost(cell, columns, [1e-6 * (1 + i) for i in range(columns * rows)])
    parts, empty = planning.cut(view, cost, size, 20, seconds)
    spans: dict[tuple[int, int, int, int], int] = dict.fromkeys(empty, 20)
    for part in parts:
        assert part.samples[0] == spans.get(part.bucket, 0) < part.samples[1]
        spans[part.bucket] = part.samples[1]
    assert set(spans.values()) == {20}
    # The renderer's own plan refuses buckets that overlap or leave a pixel out.
    core.Frame(*size, list(spans.items()))
    assert not any(view.touches(bucket) for bucket in empty)
