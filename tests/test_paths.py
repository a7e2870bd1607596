"""Path mapping: a worker whose mounts differ from the service's renders the same shot."""

import json
from pathlib import Path
from typing import Any

import pileus_core as core
import pytest
from redis import Redis

from hosts import PILEUS, process, service, until
from pileus_service.errors import InputError
from pileus_service.jobs import Plan
from pileus_service.measures import Measures
from pileus_service.queue import Queue
from pileus_service.shot import Shot
from pileus_service.store import Store
from pileus_worker.paths import PathMap


@pytest.mark.parametrize(
    ("path", "here"),
    [
        ("/mnt/show/a.vdb", "/shows/a.vdb"),
        ("/mnt/show", "/shows"),
        ("/mnt/shown/a.vdb", "/other/shown/a.vdb"),
        ("/home/a.vdb", "/home/a.vdb"),
        ("/mnt/show/fx/deep/a.####.vdb", "/fast=disk/deep/a.####.vdb"),
    ],
)
def test_the_longest_folder_that_holds_a_path_counts(path: str, here: str) -> None:
    paths = PathMap.parse(["/mnt=/other", "/mnt/show/fx=/fast=disk", "/mnt/show=/shows"])
    assert paths.here(path) == here


@pytest.mark.parametrize("text", ["/a", "a=/b", "/a=b", "=/b", "/a="])
def test_a_map_that_says_nothing_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--map"):
        PathMap.parse([text])


def test_a_folder_is_mapped_once() -> None:
    with pytest.raises(InputError, match="already"):
        PathMap.parse(["/a=/b", "/a/=/c"])


def test_a_worker_renders_where_its_own_mounts_are(
    tmp_path: Path, redis_url: str, redis: object, shot: dict[str, Any]
) -> None:
    farm, here, data = tmp_path / "farm", tmp_path / "here", tmp_path / "data"
    (farm / "caches").mkdir(parents=True)
    core.make_cloud(str(farm / "caches" / "cloud.vdb"), frame=1, frames=1, resolution=32)
    shot["frames"] = "1"
    shot["image"]["output"] = str(farm / "out" / "test.####.exr")
    shot["volumes"][0]["cache"] = str(farm / "caches" / "cloud.vdb")
    asked = Shot.model_validate(shot)
    with service(data, redis_url, farm) as client:
        job = client.submit(asked).job.id
        # From here on the farm's own path is nowhere: what is found is found through the map.
        farm.rename(here)
        command: list[str | Path] = [PILEUS, "worker", "--data", data, "--redis", redis_url]
        command += ["--root", here, "--map", f"{farm}={here}", "--threads", "1"]
        with process(tmp_path / "worker.log", *command):
            until(lambda: client.job(job).state in ("done", "failed"), 300)
        assert client.job(job).state == "done", client.job(job).reason
        assert [frame.file for frame in client.frames(job)] == [str(asked.output(1))]
    assert core.read_image(str(here / "out" / "test.0001.exr"))
    assert not farm.exists()
    frames = data / "jobs" / job / "frames" / "000001"
    plan = Plan.model_validate_json((frames / "plan.json").read_bytes())
    assert plan.cache.path == str(farm / "caches" / "cloud.vdb")
    assert json.loads((frames / "done.json").read_text())["file"] == str(asked.output(1))


def test_a_job_that_is_gone_from_the_disk_fails_nothing_and_holds_nobody_up(
    tmp_path: Path, redis_url: str, redis: Redis, shot: dict[str, Any]
) -> None:
    """As where its service was killed between the disk and Redis."""
    data = tmp_path / "data"
    (tmp_path / "caches").mkdir()
    for frame in (1, 2, 3):
        cloud = tmp_path / "caches" / f"cloud.{frame:04d}.vdb"
        core.make_cloud(str(cloud), frame=frame, frames=3, resolution=32)
    short = Shot.model_validate(shot)
    endless = Shot.model_validate({**shot, "sampling": {"samples": 1 << 18}})
    with service(data, redis_url, tmp_path) as client:
        gone, stays = (client.submit(asked).job.id for asked in (endless, short))
    store, queue = Store(data), Queue(redis)
    command: list[str | Path] = [PILEUS, "worker", "--data", data, "--redis", redis_url]
    with process(tmp_path / "worker.log", *command, "--root", tmp_path, "--threads", "1"):
        until(lambda: queue.stats().get("tasks_done"), 120)
        store.forget(gone)
        until(lambda: queue.state(stays) in ("done", "failed"), 120)
    assert queue.state(stays) == "done", queue.failed(stays)
    assert queue.state(gone) is None
    assert "attempts_failed" not in queue.stats()
    assert "failures" not in {name for name, *_ in Measures(redis).read()}


def test_a_worker_whose_data_folder_is_not_mounted_waits_and_fails_nothing(
    tmp_path: Path, redis_url: str, redis: object, shot: dict[str, Any]
) -> None:
    data, mount = tmp_path / "data", tmp_path / "mount"
    (tmp_path / "caches").mkdir()
    cloud = tmp_path / "caches" / "cloud.0001.vdb"
    core.make_cloud(str(cloud), frame=1, frames=1, resolution=32)
    shot["frames"] = "1"
    with service(data, redis_url, tmp_path) as client:
        job = client.submit(Shot.model_validate(shot)).job.id
        command: list[str | Path] = [PILEUS, "worker", "--data", mount, "--redis", redis_url]
        with process(tmp_path / "worker.log", *command, "--root", tmp_path, "--threads", "1"):
            until(lambda: any("mounted" in (each.aside or "") for each in client.workers()), 60)
            assert client.job(job).state == "queued"
            mount.rename(tmp_path / "before")
            mount.symlink_to(data)
            until(lambda: client.job(job).state in ("done", "failed"), 300)
        assert client.job(job).state == "done", client.job(job).reason
