"""The whole farm on this machine: its images, its losses, its end."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pileus_core as core
import pytest
from redis import Redis
from tenacity import Retrying, retry_if_exception_type, stop_after_delay, wait_fixed
from typer.testing import CliRunner

from pileus_service.client import Client
from pileus_service.commands.farm import NEWEST, app
from pileus_service.errors import FarmError
from pileus_service.jobs import JobView
from pileus_service.shot import Sampling, Shot, Transport
from pileus_service.store import Store
from pileus_worker.embedded import EmbeddedFarm, embedded_farm
from serial_render import pixels, plan_of, same_bits

PILEUS = Path(sys.executable).with_name("pileus")


@pytest.fixture(scope="session")
def caches(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("caches")
    for frame in (1, 2, 3):
        core.make_cloud(
            str(folder / f"cloud.{frame:04d}.vdb"), frame=frame, frames=3, resolution=48
        )
    return folder


@pytest.fixture
def real_shot(shot: dict[str, Any], caches: Path) -> Shot:
    """Small, and yet several buckets and sample ranges a frame where tasks are planned short."""
    shot["volumes"][0]["cache"] = str(caches / "cloud.####.vdb")
    shot["image"] |= {"width": 128, "height": 96}
    shot["sampling"]["samples"] = 24
    return Shot.model_validate(shot)


@pytest.fixture
def long_shot(real_shot: Shot) -> Shot:
    """One frame that takes seconds, so that something can happen to it."""
    sampling = real_shot.sampling.model_copy(update={"samples": 150})
    return real_shot.model_copy(update={"frames": "1", "sampling": sampling})


@pytest.fixture
def farm(tmp_path: Path, caches: Path) -> Iterator[EmbeddedFarm]:
    with embedded_farm(tmp_path / "farm", [tmp_path, caches], 2, "127.0.0.1:0", 0.02) as farm:
        yield farm


@pytest.fixture
def client(farm: EmbeddedFarm) -> Iterator[Client]:
    with Client(farm.url) as client:
        yield client


def until_taken(client: Client, job: str, verb: str) -> None:
    """Asks again while Redis is away."""
    for attempt in Retrying(
        retry=retry_if_exception_type(FarmError), stop=stop_after_delay(20), wait=wait_fixed(0.1)
    ):
        with attempt:
            client.control(job, verb)


def finish(client: Client, job: str) -> JobView:
    end = time.monotonic() + 120
    for view in client.watch(job):
        assert time.monotonic() < end, view
    assert view.state == "done", view.reason
    return view


def render_here(shot: Shot, tmp_path: Path) -> subprocess.CompletedProcess[str]:
    """Has `pileus render` render into the folder `here`, and report as JSON."""
    file = tmp_path / "shot.json"
    file.write_text(shot.model_dump_json())
    command = [str(PILEUS), "render", str(file), "--out", str(tmp_path / "here"), "--json"]
    return subprocess.run(command, check=True, capture_output=True, text=True)


def rendered_here(shot: Shot, tmp_path: Path) -> list[dict[str, Any]]:
    """What `pileus render` reports of each frame."""
    reports: list[dict[str, Any]] = json.loads(render_here(shot, tmp_path).stdout)["frames"]
    return reports


def test_the_farms_frames_equal_those_of_pileus_render(
    client: Client, real_shot: Shot, tmp_path: Path
) -> None:
    job = client.submit(real_shot).job.id
    view = finish(client, job)
    assert view.frames_done == 3
    assert len({part.bucket for part in plan_of(tmp_path / "farm", job, 2).parts}) > 1
    assert any(part.samples[0] > 0 for part in plan_of(tmp_path / "farm", job, 2).parts)
    reports = rendered_here(real_shot, tmp_path)
    assert [report["frame"] for report in reports] == [1, 2, 3]
    for report in reports:
        same_bits(real_shot, tmp_path / "farm", job, report["frame"], tmp_path)
        farm = pixels(real_shot.output(report["frame"]))
        for name, values in pixels(Path(report["file"])).items():
            np.testing.assert_allclose(farm[name], values, rtol=1e-6, atol=1e-6, err_msg=name)
    assert [frame.state for frame in client.frames(job)] == ["done"] * 3
    preview = Store(tmp_path / "farm").frame(job, 1).preview
    assert preview.read_bytes().startswith(b"\x89PNG")


def test_the_farm_denoises_whole_frames(client: Client, real_shot: Shot, tmp_path: Path) -> None:
    pytest.importorskip("pyoidn")
    # Wider than any bucket: two of them however fast the machine is.
    image = real_shot.image.model_copy(update={"width": 520, "height": 16, "denoise": True})
    shot = real_shot.model_copy(update={"image": image, "frames": "2"})
    job = client.submit(shot).job.id
    finish(client, job)
    assert len({part.bucket for part in plan_of(tmp_path / "farm", job, 2).parts}) > 1
    assert "noisy.R" in pixels(shot.output(2))
    same_bits(shot, tmp_path / "farm", job, 2, tmp_path)


@pytest.mark.parametrize("denoise", [False, True])
def test_auto_decides_and_samples_in_the_farm_as_here(
    client: Client, real_shot: Shot, tmp_path: Path, denoise: bool
) -> None:
    if denoise:
        pytest.importorskip("pyoidn")
    shot = real_shot.model_copy(
        update={
            "image": real_shot.image.model_copy(update={"denoise": denoise}),
            "transport": Transport(method="auto"),
            "sampling": Sampling(samples=512, tolerance=0.1, seed=7),
        }
    )
    job = client.submit(shot).job.id
    finish(client, job)
    reports = rendered_here(shot, tmp_path)
    # What was taken is told, not what might have been.
    most = sum(report["samples"] + 0.5 for report in reports)
    assert 0 < client.job(job).samples <= most * shot.image.width * shot.image.height
    for report in reports:
        assert report["method"] == "similarity"
        # The error is that of what was rendered; denoised it is smaller.
        assert report["unmet_buckets"] == 0
        assert (report["error"] <= 0.1) != denoise
        assert 2 <= report["samples"] < 512
        farm = pixels(shot.output(report["frame"]))
        for name, values in pixels(Path(report["file"])).items():
            np.testing.assert_array_equal(farm[name], values, name)


def test_buckets_that_miss_the_tolerance_are_told(
    client: Client, real_shot: Shot, tmp_path: Path
) -> None:
    shot = real_shot.model_copy(update={"sampling": Sampling(samples=2, tolerance=1e-3)})
    job = client.submit(shot).job.id
    finish(client, job)
    here = [report["unmet_buckets"] for report in rendered_here(shot, tmp_path)]
    assert min(here) > 0
    assert [frame.unmet_buckets for frame in client.frames(job)] == here


def test_what_is_odd_in_caches_and_textures_is_told(
    client: Client, real_shot: Shot, tmp_path: Path
) -> None:
    cache, sky = tmp_path / "odd.vdb", tmp_path / "sky.exr"
    voxels = np.ones((8, 8, 8), np.float32)
    voxels[0, 0] = np.nan
    core.write_grid(str(cache), [((0, 0, 0), voxels)], voxel=(0.1,) * 3, origin=(-0.4,) * 3)
    texels = np.ones((4, 8), np.float32)
    texels[1, :3] = -1
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, dict.fromkeys("RGB", texels)).write(str(sky))
    odd = real_shot.model_dump(mode="json") | {"frames": "1"}
    odd["volumes"][0]["cache"] = str(cache)
    odd["lights"][1]["texture"] = str(sky)
    shot = Shot.model_validate(odd)
    job = client.submit(shot).job.id
    finish(client, job)
    here = render_here(shot, tmp_path)
    [report] = json.loads(here.stdout)["frames"]
    of_cache, of_sky = report["warnings"]
    assert of_cache.startswith(f"{cache}: ") and "8 NaN voxels" in of_cache
    assert of_sky.startswith(f"{sky}: ") and "9 values" in of_sky
    assert [frame.warnings for frame in client.frames(job)] == [report["warnings"]]
    [planned] = [line for line in client.log(job, 1) if (line.task, line.event) == ("plan", "done")]
    for warning in report["warnings"]:
        assert here.stderr.count(f"frame 1: warning: {warning}\n") == 1
        assert (planned.output or "").count(f"warning: {warning}") == 1


def test_killed_workers_change_no_bit(
    farm: EmbeddedFarm, client: Client, long_shot: Shot, tmp_path: Path
) -> None:
    job = client.submit(long_shot).job.id
    killed: set[int] = set()
    end = time.monotonic() + 60
    while len(killed) < 2:
        assert time.monotonic() < end
        # While its parts are rendered all workers have their hands full.
        seen = client.job(job)
        assert seen.state in ("queued", "running")
        alive = {worker.pid for worker in client.workers() if worker.alive}
        for victim in sorted(alive - killed)[:1] if seen.tasks > 10 * len(killed) else ():
            os.kill(victim, signal.SIGKILL)
            killed.add(victim)
        time.sleep(0.02)
    finish(client, job)
    same_bits(long_shot, tmp_path / "farm", job, 1, tmp_path)


def test_what_a_killed_writer_left_is_swept_with_its_frame(
    farm: EmbeddedFarm, client: Client, long_shot: Shot, tmp_path: Path
) -> None:
    job = client.submit(long_shot).job.id
    folder = tmp_path / "farm" / "jobs" / job / "frames" / "000001"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / ".plan.json.1.0").write_text('{"half')
    finish(client, job)
    assert not list(folder.glob(".*"))


@pytest.mark.parametrize("loss", ["emptied", "killed"])
def test_a_lost_redis_loses_nothing_and_renders_nothing_twice(
    farm: EmbeddedFarm, client: Client, long_shot: Shot, tmp_path: Path, loss: str
) -> None:
    job = client.submit(long_shot).job.id
    parts = tmp_path / "farm" / "jobs" / job / "frames"
    end = time.monotonic() + 60
    while not list(parts.glob("000001/parts/*.exr")):
        assert time.monotonic() < end
        time.sleep(0.02)
    client.control(job, "pause")
    time.sleep(1.5)
    before = {path: path.stat().st_mtime_ns for path in parts.glob("*/parts/*.exr")}
    if loss == "killed":
        os.kill(farm.redis.pid, signal.SIGKILL)
    else:
        with Redis.from_url(farm.redis.url) as redis:
            redis.flushall()
    until_taken(client, job, "resume")
    kept = dict.fromkeys(before, False)
    for _ in client.watch(job):
        for path, written in before.items():
            if path.exists():
                assert path.stat().st_mtime_ns == written
                kept[path] = True
    assert client.job(job).state == "done"
    assert any(kept.values())
    same_bits(long_shot, tmp_path / "farm", job, 1, tmp_path)


@pytest.mark.parametrize("damage", ["flipped", "truncated", "missing", "foreign", "plan"])
def test_what_is_damaged_on_disk_is_made_again(
    client: Client, long_shot: Shot, tmp_path: Path, damage: str
) -> None:
    job = client.submit(long_shot).job.id
    parts = tmp_path / "farm" / "jobs" / job / "frames" / "000001" / "parts"
    end = time.monotonic() + 60
    while not (files := list(parts.glob("*.exr"))):
        assert time.monotonic() < end
        time.sleep(0.01)
    client.control(job, "pause")
    victim = parts.with_name("plan.json") if damage == "plan" else files[0]
    data = bytearray(victim.read_bytes())
    if damage == "flipped":
        data[len(data) // 2] ^= 0x10
        victim.write_bytes(data)
    elif damage in ("truncated", "plan"):
        victim.write_bytes(data[: len(data) // 2])
    elif damage == "missing":
        victim.unlink()
    else:  # whole, but of another shot
        core.Partial.read(str(victim)).write(str(victim), "another")
    client.control(job, "resume")
    finish(client, job)
    same_bits(long_shot, tmp_path / "farm", job, 1, tmp_path)


def test_a_cancelled_render_stops_within_two_seconds(client: Client, real_shot: Shot) -> None:
    endless = real_shot.model_copy(
        update={"sampling": real_shot.sampling.model_copy(update={"samples": 1 << 18})}
    )
    job = client.submit(endless).job.id
    end = time.monotonic() + 30
    while not any(worker.task and worker.task.kind == "render" for worker in client.workers()):
        assert time.monotonic() < end
        time.sleep(0.1)
    begun = time.monotonic()
    client.control(job, "cancel")
    while any(worker.task for worker in client.workers()):
        assert time.monotonic() - begun < 2.0
        time.sleep(0.05)


def test_a_render_child_has_limits(farm: EmbeddedFarm, client: Client, real_shot: Shot) -> None:
    finish(client, client.submit(real_shot).job.id)
    workers = [worker.pid for worker in client.workers() if worker.alive]
    children = [child for worker in workers for child in _descendants(worker)]
    # Beside each child runs a helper of Python's own, which reads nothing that users give.
    rendering = [each for each in children if "resource_tracker" not in _command(each)]
    assert rendering
    for child in rendering:
        limits = Path(f"/proc/{child}/limits").read_text()
        for name in ("cpu time", "data size", "file size", "core file size"):
            soft = re.search(rf"Max {name} +(\S+)", limits)
            assert soft is not None
            assert soft[1] != "unlimited", name


def test_a_frame_that_cannot_be_rendered_fails_alone_with_the_reason(
    client: Client, real_shot: Shot, tmp_path: Path, caches: Path
) -> None:
    own = tmp_path / "own"
    shutil.copytree(caches, own)
    (own / "cloud.0002.vdb").write_bytes(b"no vdb")
    volume = real_shot.volumes[0].model_copy(update={"cache": str(own / "cloud.####.vdb")})
    job = client.submit(real_shot.model_copy(update={"volumes": (volume,)})).job.id
    *_, view = client.watch(job)
    assert (view.state, view.frames_done, view.frames_failed) == ("failed", 2, 1)
    frames = {frame.frame: frame for frame in client.frames(job)}
    assert frames[2].state == "failed"
    assert "cloud.0002.vdb" in (frames[2].reason or "")


def test_the_commands_list_all_jobs_hurry_one_and_delete_them(
    client: Client,
    farm: EmbeddedFarm,
    shot: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def command(*words: str) -> list[str]:
        """The lines that are told, after those of the service, which is in this process."""
        ended = CliRunner().invoke(app, [*words, "--server", farm.url])
        assert ended.exit_code == 0, ended.output
        return ended.output.splitlines()

    # Their caches never come, so that nothing happens to them meanwhile.
    sent = [
        client.submit(Shot.model_validate(shot), wait_for_caches=True).job.id
        for _ in range(NEWEST + 1)
    ]
    monkeypatch.setattr("pileus_service.client.PAGE", 40)
    assert {job["id"] for job in json.loads(command("list", "--json")[-1])} == {*sent}
    listed = command("list")
    assert sum(job in "\n".join(listed) for job in sent) == NEWEST
    assert "more than these" in listed[-1]
    assert command("priority", sent[0], "9")[-1] == f"{sent[0]}: priority 9"
    assert client.job(sent[0]).priority == 9
    command("delete", *sent)
    assert not [*client.jobs()]
    assert not [*Store(tmp_path / "farm").folders()]


def test_status_tells_what_frames_wait_for(
    client: Client, farm: EmbeddedFarm, shot: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    job = client.submit(Shot.model_validate(shot), wait_for_caches=True).job.id
    cache = shot["volumes"][0]["cache"]
    expected = {
        f"frame {n}: volumes.0.cache: {cache.replace('####', f'{n:04d}')} is not there yet"
        for n in (1, 2, 3)
    }
    told: set[str] = set()
    end = time.monotonic() + 60
    while not told >= expected:  # one that is just looked for again is told as planning
        assert time.monotonic() < end, told
        ended = CliRunner().invoke(app, ["status", job, "--server", farm.url])
        assert ended.exit_code == 0, ended.output
        told = {line.strip() for line in ended.output.splitlines()}


def test_who_waits_for_a_job_knows_it_and_that_it_goes_on(
    client: Client, farm: EmbeddedFarm, shot: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "shot.json").write_text(json.dumps(shot))
    waiting = ["--wait", "--wait-for-caches", "--server", farm.url]
    process = subprocess.Popen(
        [PILEUS, "submit", tmp_path / "shot.json", *waiting],
        stderr=subprocess.PIPE,
        text=True,
        # A shell has what it starts in the background ignore it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stderr is not None
    job, _, told = process.stderr.readline().partition(": ")
    assert told == "taken\n"
    assert client.job(job).name == shot["name"]
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 128 + signal.SIGINT
    assert f"{job} goes on; `pileus status {job}`" in errors
    assert client.job(job).state in ("queued", "running")


def test_steering_that_does_nothing_says_so(
    client: Client, farm: EmbeddedFarm, shot: dict[str, Any]
) -> None:
    def told(*words: str) -> str:
        ended = CliRunner().invoke(app, [*words, "--server", farm.url])
        assert ended.exit_code == 0, ended.output
        return ended.output.splitlines()[-1]

    job = client.submit(Shot.model_validate(shot), wait_for_caches=True).job.id
    assert told("retry", job).endswith("no frame failed; nothing to retry")
    assert told("pause", job) == f"{job}: paused"
    assert told("cancel", job) == f"{job}: cancelled"
    for verb in ("cancel", "pause", "resume"):
        assert told(verb, job) == f"{job}: cancelled already; nothing to {verb}"
    assert told("priority", job, "9") == f"{job}: cancelled already; its priority stays 5"


def test_the_embedded_farm_ends_cleanly_on_ctrl_c(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [PILEUS, "up", "--workers", "2", "--listen", "127.0.0.1:0", "--data", tmp_path / "farm"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert "The farm is up" in process.stdout.readline()
    children = _descendants(process.pid)
    assert len(children) >= 3
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    assert not [pid for pid in children if _runs(pid)]


def _runs(pid: int) -> bool:
    """One that has ended and that the system has yet to bury does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def _command(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_text()


def _descendants(pid: int) -> list[int]:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [each for child in children for each in (int(child), *_descendants(int(child)))]
