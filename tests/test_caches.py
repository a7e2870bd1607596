"""Volumes in memory: read once, ahead, bounded by bytes, and anew where their files changed; and
those that are still in the making."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pileus_core as core
import pytest

from pileus_service.farm import Farm
from pileus_service.jobs import Cache, Kind, Planned, Result, Waiting
from pileus_service.shot import Shot
from pileus_worker.caches import Caches
from pileus_worker.paths import NOWHERE_ELSE
from pileus_worker.tasks import Work

Clouds = list[Cache]


def named(path: Path) -> Cache:
    found = path.stat()
    return Cache(path=str(path), mtime_ns=found.st_mtime_ns, size=found.st_size)


@pytest.fixture
def clouds(tmp_path: Path) -> Clouds:
    """Three files of one size."""
    paths = [tmp_path / f"{name}.vdb" for name in "abc"]
    core.make_cloud(str(paths[0]), frame=1, frames=1, resolution=24)
    for path in paths[1:]:
        path.write_bytes(paths[0].read_bytes())
    return [named(path) for path in paths]


@pytest.fixture
def held(clouds: Clouds) -> Callable[[float], Caches]:
    """With room for so many of the clouds."""
    size = core.Volume(clouds[0].path, "density").bytes
    return lambda clouds: Caches(int(clouds * size))


def test_a_volume_is_read_once_while_there_is_room(
    clouds: Clouds, held: Callable[[float], Caches]
) -> None:
    caches = held(3.5)
    first = [caches.get(cloud, "density") for cloud in clouds]
    again = [caches.get(cloud, "density") for cloud in clouds]
    assert all(a is b for a, b in zip(first, again, strict=True))
    assert caches.bytes_read == 3 * clouds[0].size


def test_the_one_that_was_wanted_least_recently_goes_first(
    clouds: Clouds, held: Callable[[float], Caches]
) -> None:
    caches, (a, b, c) = held(2.5), clouds
    for cloud in (a, b, a, c):  # b makes room for c
        caches.get(cloud, "density")
    assert caches.bytes_read == 3 * a.size
    caches.get(a, "density")
    caches.get(c, "density")
    assert caches.bytes_read == 3 * a.size
    caches.get(b, "density")
    assert caches.bytes_read == 4 * a.size


def test_reading_ahead_reads_what_is_wanted_next_once(
    clouds: Clouds, held: Callable[[float], Caches]
) -> None:
    caches, (a, b, _) = held(2.5), clouds
    caches.get(a, "density")
    caches.read_ahead(b, "density")
    end = time.monotonic() + 30
    while caches.bytes_read < 2 * a.size and time.monotonic() < end:
        time.sleep(0.01)
    Path(b.path).unlink()
    caches.get(b, "density")
    caches.get(a, "density")
    assert caches.bytes_read == 2 * a.size


def test_nothing_is_read_ahead_where_there_is_no_room(
    clouds: Clouds, held: Callable[[float], Caches]
) -> None:
    caches, (a, b, _) = held(1.5), clouds
    caches.get(a, "density")
    path = Path(b.path)
    hidden = path.rename(path.with_suffix(".hidden"))
    caches.read_ahead(b, "density")
    time.sleep(0.2)  # a reader would have met no file by now, and its failure be kept
    hidden.rename(path)
    caches.get(b, "density")


def test_a_file_that_changes_is_read_anew_and_a_failure_is_not_kept(
    clouds: Clouds, held: Callable[[float], Caches]
) -> None:
    caches, path = held(9), Path(clouds[0].path)
    before = caches.get(clouds[0], "density")
    hidden = path.rename(path.with_suffix(".hidden"))
    later = clouds[0].model_copy(update={"mtime_ns": clouds[0].mtime_ns + 1})
    with pytest.raises(core.InputError, match=r"a\.vdb"):
        caches.get(later, "density")
    hidden.rename(path)
    after = caches.get(later, "density")
    assert after is not before
    assert after.active_voxels == before.active_voxels


@pytest.fixture
def plan(farm: Farm, shot: dict[str, Any], tmp_path: Path) -> Callable[[int], Result]:
    """Plans a frame of a job that waits for its caches; the first one's is half written just now,
    and the others are whole and old."""
    for frame in (1, 2, 3):
        path = tmp_path / "caches" / f"cloud.{frame:04d}.vdb"
        core.make_cloud(str(path), frame=frame, frames=3, resolution=32)
        os.utime(path, (0, 0))
    first = tmp_path / "caches" / "cloud.0001.vdb"
    first.rename(tmp_path / "whole")
    first.write_bytes((tmp_path / "whole").read_bytes()[:2000])
    shot["sampling"] = {"samples": 16, "tolerance": 0.2}
    shot["transport"] = {"method": "auto"}
    view, _ = farm.submit(Shot.model_validate(shot), 5, None, wait_for_caches=True)
    job = farm.store.job(view.id)
    assert job is not None

    def run(frame: int) -> Result:
        return Work(farm.store, farm.roots, Caches(1 << 30), 1, 1.0, job, frame,
                    Kind.PLAN, 0, NOWHERE_ELSE, lambda: None, False).run()  # fmt: skip

    return run


def test_the_first_frames_cache_is_waited_for_where_auto_measures_it(
    plan: Callable[[int], Result], tmp_path: Path
) -> None:
    first = tmp_path / "caches" / "cloud.0001.vdb"
    for _ in range(2):  # at the second look it is as it was, and is read
        told = plan(2)
        assert isinstance(told, Waiting) and "cloud.0001.vdb" in told.wait
    first.unlink()
    told = plan(3)
    assert isinstance(told, Waiting) and "cloud.0001.vdb" in told.wait
    (tmp_path / "whole").rename(first)
    assert isinstance(plan(1), Planned)
    first.unlink()
    assert isinstance(plan(2), Planned), "by the first one's plan"


def test_no_clock_of_a_host_makes_a_cache_whole(
    plan: Callable[[int], Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 3600)
    for _ in range(3):
        assert isinstance(plan(1), Waiting)
