"""Each fault that the farm survives, brought about for real; see docs/reliability.md."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from chaos.farm import Farm, Part, frozen, until
from chaos.run import chaos
from pileus_service.jobs import TERMINAL, Job, JobView, Wish
from pileus_service.shot import Shot
from serial_render import same_bits


def ended(farm: Farm, job: str) -> JobView:
    *_, view = farm.client.watch(job)
    print(view.model_dump_json(exclude_none=True))  # shown where a test fails
    return view


def longer(shot: Shot, samples: int, frames: str = "1") -> Shot:
    sampling = shot.sampling.model_copy(update={"samples": samples})
    return shot.model_copy(update={"frames": frames, "sampling": sampling})


def with_cache(shot: Shot, cache: Path) -> Shot:
    volume = shot.volumes[0].model_copy(update={"cache": str(cache)})
    return shot.model_copy(update={"volumes": (volume,)})


def parts(farm: Farm, job: str) -> dict[Path, int]:
    """The partials on disk, with the time each was written."""
    found = {}
    for path in (farm.data / "jobs" / job).glob("frames/*/parts/*.exr"):
        with contextlib.suppress(FileNotFoundError):
            found[path] = path.stat().st_mtime_ns
    return found


def busy(farm: Farm) -> list[int]:
    """The pids of workers that have a task."""
    return [worker.pid for worker in farm.queue.workers() if worker.alive and worker.task]


@pytest.mark.parametrize(
    "size",
    [
        {"tasks": 250, "workers": 3, "frames": 1, "kill_every": 1.5},
        pytest.param(
            {"tasks": 100_000, "workers": 10, "frames": 20, "kill_every": 2.0},
            marks=pytest.mark.slow,
        ),
    ],
    ids=["small", "full"],
)
def test_frames_are_right_whatever_is_killed(size: dict[str, int], tmp_path: Path) -> None:
    figures = chaos(tmp_path, seed=1, **size)
    print(figures)
    assert figures["left_over"] == []
    assert figures["kills"]


def test_a_child_that_dies_while_it_starts_costs_no_attempt(
    cached_shot: Shot, tmp_path: Path
) -> None:
    with Farm(tmp_path, [tmp_path], 1) as farm:
        job = farm.client.submit(cached_shot).job.id
        [worker] = farm.workers
        killed: set[int] = set()

        def enough() -> bool:
            for pid in worker.children:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                    killed.add(pid)
            return len(killed) > 5

        until(enough)
        assert ended(farm, job).state == "done"
        assert farm.queue.stats().get("attempts_failed", 0) == 0


def test_a_child_that_dies_at_rest_keeps_its_worker_from_nothing(
    cached_shot: Shot, tmp_path: Path
) -> None:
    with Farm(tmp_path, [tmp_path], 1) as farm:
        assert ended(farm, farm.client.submit(cached_shot).job.id).state == "done"
        [worker] = farm.workers
        before = worker.children
        child = before[-1]  # multiprocessing's own helper comes first
        os.kill(child, signal.SIGKILL)
        until(lambda: len(worker.children) == len(before) and child not in worker.children)
        assert [seen.aside for seen in farm.queue.workers()] == [None]


def test_a_frame_that_no_shot_has_costs_no_worker(cached_shot: Shot, tmp_path: Path) -> None:
    """As where Redis still speaks of a job that was removed and made anew under its key."""
    with Farm(tmp_path, [tmp_path], 1) as farm:
        [pid] = [part.pid for part in farm.workers]
        one = cached_shot.model_copy(update={"frames": "1"})
        farm.store.create(Job(id="odd", created=time.time(), shot=one), Wish())
        farm.queue.submit("odd", "odd", time.time(), 3, Wish())
        until(lambda: farm.queue.state("odd") == "failed")
        seen = farm.queue.job("odd")
        assert seen and (seen.frames_done, seen.frames_failed) == (1, 2)
        assert [part.pid for part in farm.workers] == [pid]


def test_a_worker_whose_renderer_does_not_start_is_set_aside_until_it_does(
    cached_shot: Shot, tmp_path: Path
) -> None:
    host = tmp_path / "host"
    host.mkdir()
    (host / "pileus_core.py").write_text("raise ImportError('libopenvdb.so: no such file')")
    with Farm(tmp_path, [tmp_path], 1) as farm:
        farm.until_workers(1)
        [well] = [worker.name for worker in farm.client.workers()]
        sick = Part(farm.worker_command, tmp_path / "sick.log", {"PYTHONPATH": str(host)})

        def trouble() -> str | None:
            return next(each.aside for each in farm.client.workers() if each.pid == sick.pid)

        def workers_of(job: str) -> set[str]:
            assert ended(farm, job).state == "done"
            return {line.worker for frame in (1, 2, 3) for line in farm.client.log(job, frame)}

        try:
            farm.until_workers(2)
            until(lambda: trouble() is not None)
            assert "libopenvdb.so: no such file" in (trouble() or "")
            assert workers_of(farm.client.submit(cached_shot).job.id) == {well}
            assert farm.queue.stats().get("attempts_failed", 0) == 0
            shutil.rmtree(host)
            until(lambda: trouble() is None)
            farm.client.drain(well)
            again = workers_of(farm.client.submit(longer(cached_shot, 17, "1-3")).job.id)
            assert again and well not in again
            assert sick.process.poll() is None
        finally:
            sick.end()


@pytest.mark.slow
@pytest.mark.parametrize("whole", [False, True], ids=["supervisor", "supervisor and child"])
def test_a_thawed_worker_changes_nothing(cached_shot: Shot, tmp_path: Path, whole: bool) -> None:
    shot = longer(cached_shot, 3000)
    with Farm(tmp_path, [tmp_path], 2, task_seconds=3) as farm:
        job = farm.client.submit(shot).job.id
        until(lambda: len(busy(farm)) == 2)
        victim = next(w for w in farm.workers if w.pid in busy(farm))
        with frozen(victim.pid, *(victim.children if whole else [])):
            assert ended(farm, job).state == "done"
            image = shot.output(1).read_bytes()
            assert farm.queue.stats()["leases_lost"] >= 1
        time.sleep(5)
        assert shot.output(1).read_bytes() == image
        assert farm.leftovers() == []
        same_bits(shot, farm.data, job, 1, tmp_path)


def test_a_redis_of_an_earlier_hour_is_put_right(cached_shot: Shot, tmp_path: Path) -> None:
    with Farm(tmp_path, [tmp_path], 2) as farm:
        early = farm.client.submit(cached_shot).job.id
        late = farm.client.submit(longer(cached_shot, 300)).job.id
        gone = farm.client.submit(longer(cached_shot, 1 << 18)).job.id
        dropped = farm.client.submit(longer(cached_shot, 1 << 18)).job.id
        farm.client.control(late, "pause")
        snapshot = tmp_path / "snapshot"
        until(lambda: farm.queue.redis.info("persistence")["aof_rewrite_in_progress"] == 0)
        shutil.copytree(tmp_path / "redis", snapshot)
        farm.client.control(gone, "cancel")
        httpx.delete(f"http://{farm.listen}/v1/jobs/{dropped}").raise_for_status()
        farm.client.control(late, "resume")
        until(lambda: len(parts(farm, late)) > 3)
        farm.client.control(late, "pause")
        assert ended(farm, early).state == "done"
        until(lambda: not busy(farm))
        written = {path: path.stat().st_mtime_ns for path in tmp_path.glob("out/*.exr")}
        before = parts(farm, late)
        with frozen(farm.service.pid):
            os.kill(farm.redis.pid, signal.SIGSTOP)
            shutil.rmtree(tmp_path / "redis")
            shutil.copytree(snapshot, tmp_path / "redis")
            os.kill(farm.redis.pid, signal.SIGKILL)
        farm.until_served()
        until(lambda: farm.queue.state(gone) == "cancelled" and farm.queue.state(dropped) is None)
        kept: set[Path] = set()
        farm.client.control(late, "resume")
        for _ in farm.client.watch(late):
            now = parts(farm, late)
            kept |= before.keys() & now.keys()
            assert all(now[path] == before[path] for path in before.keys() & now.keys())
        assert kept
        assert ended(farm, early).state == "done"
        for path, time_written in written.items():
            if path != cached_shot.output(1):  # `late` writes its frame there, too
                assert path.stat().st_mtime_ns == time_written
        same_bits(longer(cached_shot, 300), farm.data, late, 1, tmp_path)


def test_a_killed_service_is_back_and_whoever_watches_goes_on(
    cached_shot: Shot, tmp_path: Path
) -> None:
    heard: list[JobView] = []
    connections = 0

    def listen(address: str) -> None:
        """As a browser does: where a stream breaks off, it asks for it again."""
        nonlocal connections
        while not heard or heard[-1].state not in TERMINAL:
            with contextlib.suppress(httpx.TransportError), httpx.stream("GET", address) as answer:
                connections += 1
                for line in answer.iter_lines():
                    if line.startswith("data:"):
                        heard.append(JobView.model_validate_json(line[5:]))
            time.sleep(0.05)

    with Farm(tmp_path, [tmp_path], 1) as farm, ThreadPoolExecutor(1) as crowd:
        job = farm.client.submit(longer(cached_shot, 400)).job.id
        watch = farm.client.watch(job)
        ear = crowd.submit(listen, f"http://{farm.listen}/v1/jobs/{job}/events")
        until(lambda: any(view.samples for view in heard))
        next(watch)
        killed = farm.service.process
        killed.kill()
        killed.wait()
        print(f"the service was away for {farm.until_served():.1f} s")
        *_, last = watch
        ear.result(120)
    assert last.state == heard[-1].state == "done"
    assert connections >= 2
    rendered = [view.samples for view in heard]
    assert rendered == sorted(rendered), "progress goes on from where it was"


@contextlib.contextmanager
def small_disk(folder: Path, size: str) -> Iterator[None]:
    """A file system of its own, if this machine lets us mount one."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("no right to mount a file system")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.mark.parametrize("trouble", ["full", "read-only"])
def test_a_disk_that_is_mended_takes_the_frames_it_refused(
    cached_shot: Shot, tmp_path: Path, trouble: str
) -> None:
    out = tmp_path / "out"
    with small_disk(out, "400k"), Farm(tmp_path, [tmp_path], 2) as farm:
        job = farm.client.submit(cached_shot).job.id
        if trouble == "full":
            (out / "ballast").write_bytes(b"x" * (360 << 10))
        else:
            subprocess.run(["mount", "-o", "remount,ro", str(out)], check=True)
        view = ended(farm, job)
        assert view.state == "failed"
        told = "no space left" if trouble == "full" else "read-only file system"
        assert told in (view.reason or "").lower()
        assert all(worker.aside is None for worker in farm.queue.workers())
        told = httpx.get(f"http://{farm.listen}/metrics").text
        assert 'pileus_attempt_failures_total{cause="input"} 0.0' in told
        kept = parts(farm, job)
        if trouble == "full":
            (out / "ballast").unlink()
        else:
            subprocess.run(["mount", "-o", "remount,rw", str(out)], check=True)
        assert not list(out.rglob("*.exr"))
        farm.client.control(job, "retry")
        assert ended(farm, job).state == "done"
        for frame in (1, 2, 3):
            same_bits(cached_shot, farm.data, job, frame, tmp_path)
        assert kept
        assert farm.leftovers() == []
        assert not list(out.glob(".*"))


def test_a_full_data_folder_holds_the_farm_until_there_is_room(
    cached_shot: Shot, tmp_path: Path
) -> None:
    with small_disk(tmp_path / "farm", "8m"), Farm(tmp_path / "farm", [tmp_path], 2) as farm:
        job = farm.client.submit(longer(cached_shot, 100, "1-3")).job.id
        until(lambda: bool(parts(farm, job)))
        ballast = tmp_path / "farm" / "ballast"
        with contextlib.suppress(OSError), ballast.open("wb") as file:
            while True:
                file.write(b"x" * 4096)
        time.sleep(5)
        ballast.unlink()
        until(lambda: farm.until_served() >= 0 and farm.client.job(job).state in ("failed", "done"))
        if farm.client.job(job).state == "failed":
            assert "No space left" in (farm.client.job(job).reason or "")
            farm.client.control(job, "retry")
        assert ended(farm, job).state == "done"
        for frame in (1, 2, 3):
            same_bits(longer(cached_shot, 100, "1-3"), farm.data, job, frame, tmp_path)
        assert farm.leftovers() == []


def test_caches_in_the_making_are_waited_for_and_only_failed_frames_retried(
    cached_shot: Shot, tmp_path: Path
) -> None:
    caches = tmp_path / "caches"
    whole = {n: (caches / f"cloud.{n:04d}.vdb").read_bytes() for n in (1, 2, 3)}
    (caches / "cloud.0001.vdb").unlink()
    (caches / "cloud.0002.vdb").write_bytes(whole[2][:2000])
    with Farm(tmp_path, [tmp_path], 2) as farm:
        waits = farm.client.submit(cached_shot, wait_for_caches=True).job.id
        with pytest.raises(ValueError, match="gap"):
            farm.client.submit(cached_shot)
        until(lambda: farm.client.job(waits).frames_done == 1)
        reasons = {frame.frame: frame.reason or "" for frame in farm.client.frames(waits)}
        assert "not there yet" in reasons[1]
        for size in range(3000, len(whole[2]), len(whole[2]) // 5):  # as a simulation writes
            (caches / "cloud.0002.vdb").write_bytes(whole[2][:size])
            time.sleep(1)
        for frame in (1, 2):
            (caches / f"cloud.{frame:04d}.vdb").write_bytes(whole[frame])
        assert ended(farm, waits).state == "done"
        for frame in (1, 2, 3):
            same_bits(cached_shot, farm.data, waits, frame, tmp_path)
            cached_shot.output(frame).unlink()

        (caches / "cloud.0002.vdb").write_bytes(whole[2][:2000])
        cut = farm.client.submit(cached_shot).job.id
        view = ended(farm, cut)
        assert (view.state, view.frames_done, view.frames_failed) == ("failed", 2, 1)
        assert "frame 2: plan failed" in (view.reason or "")
        untouched = {n: cached_shot.output(n).stat().st_mtime_ns for n in (1, 3)}
        (caches / "cloud.0002.vdb").write_bytes(whole[2])
        farm.client.control(cut, "retry")
        assert ended(farm, cut).state == "done"
        assert untouched == {n: cached_shot.output(n).stat().st_mtime_ns for n in (1, 3)}
        same_bits(cached_shot, farm.data, cut, 2, tmp_path)


@pytest.mark.parametrize("what", ["cache", "texture"])
def test_a_file_that_changes_while_it_renders_gives_no_frame_of_two(
    cached_shot: Shot, tmp_path: Path, what: str
) -> None:
    caches = tmp_path / "caches"
    red, blue = (b"P6 2 1 255 " + 2 * bytes(rgb) for rgb in ((250, 20, 20), (20, 20, 250)))
    changes, then = {
        "cache": (caches / "cloud.0001.vdb", (caches / "cloud.0003.vdb").read_bytes()),
        "texture": (tmp_path / "sky.ppm", blue),
    }[what]
    (tmp_path / "sky.ppm").write_bytes(red)
    sun, dome = cached_shot.lights
    lights = (sun, dome.model_copy(update={"texture": str(tmp_path / "sky.ppm")}))
    shot = longer(cached_shot, 300).model_copy(update={"lights": lights})
    with Farm(tmp_path, [tmp_path], 2) as farm:
        job = farm.client.submit(shot).job.id
        until(lambda: len(parts(farm, job)) > 3)
        changes.write_bytes(then)
        assert ended(farm, job).state == "done"
        same_bits(shot, farm.data, job, 1, tmp_path)


@pytest.mark.slow
def test_a_merge_that_takes_long_and_gets_on_is_no_hang(
    cached_shot: Shot, tmp_path: Path, faults: Path
) -> None:
    """As one of twenty thousand partials, or of some on a slow disk."""
    shot = longer(cached_shot, 200)
    env = {"LD_PRELOAD": str(faults), "FAULT": "slow", "FAULT_FILE": ".exr"}
    options = ("--stall-seconds=5",)
    with Farm(tmp_path / "farm", [tmp_path], 2, options=options, env=env) as farm:
        job = farm.client.submit(shot).job.id
        assert ended(farm, job).state == "done"
        assert "attempts_failed" not in farm.queue.stats()
        same_bits(shot, farm.data, job, 1, tmp_path)


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("crash", "died of signal 11"),
        ("eat", "of memory|signal 6"),
        pytest.param("hang", "got nowhere", marks=pytest.mark.slow),
    ],
)
def test_a_cache_that_ruins_its_reader_costs_its_frame_and_no_worker(
    cached_shot: Shot, tmp_path: Path, faults: Path, fault: str, reason: str
) -> None:
    """Frame 2 does it, also while it is read ahead for frame 1."""
    options = ("--memory=0.5", "--stall-seconds=10")
    env = {"LD_PRELOAD": str(faults), "FAULT": fault, "FAULT_FILE": "cloud.0002.vdb"}
    with Farm(tmp_path / "farm", [tmp_path], 3, options=options, env=env) as farm:
        farm.until_workers(3)
        pids = {part.pid for part in farm.workers}
        job = farm.client.submit(cached_shot).job.id
        view = ended(farm, job)
        assert (view.state, view.frames_done, view.frames_failed) == ("failed", 2, 1)
        [told] = [frame.reason or "" for frame in farm.client.frames(job) if frame.frame == 2]
        assert len(re.findall(reason, told)) == 3, "each of three workers tried"
        failed = [line for line in farm.client.log(job, 2) if line.event == "failed"]
        assert {line.worker for line in failed} == {w.name for w in farm.queue.workers()}
        assert all(re.search(reason, line.reason or "") for line in failed)
        assert pids == {part.pid for part in farm.workers}
        assert all(worker.aside is None for worker in farm.queue.workers())
