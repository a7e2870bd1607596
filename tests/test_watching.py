"""What the farm tells of itself: attempts' logs and counters."""

import contextlib
import io
import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pileus_core as core
import pytest
import structlog
from hypothesis import given, settings
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families
from rich.console import Console

from pileus_service import doctor, framelog, logs, terminal
from pileus_service.client import Client
from pileus_service.jobs import (
    Doing,
    FrameMap,
    FrameView,
    Job,
    JobState,
    JobView,
    Kind,
    Wish,
    WorkerView,
)
from pileus_service.progress import Display, Row
from pileus_service.shot import Shot
from pileus_service.store import Store
from pileus_worker import child
from pileus_worker.embedded import EmbeddedFarm, Workers, embedded_farm
from pileus_worker.logfile import LOG_BYTES
from pileus_worker.output import Output
from pileus_worker.paths import NOWHERE_ELSE
from pileus_worker.private_redis import PrivateRedis
from pileus_worker.supervisor import Child
from serial_render import plan_of

PILEUS = str(Path(sys.executable).with_name("pileus"))


@pytest.fixture
def one_frame(shot: dict[str, Any], tmp_path: Path) -> Shot:
    (tmp_path / "caches").mkdir()
    core.make_cloud(str(tmp_path / "caches" / "cloud.0001.vdb"), frame=1, frames=1, resolution=48)
    shot |= {"frames": "1", "sampling": {"samples": 1 << 18}}
    return Shot.model_validate(shot)


@pytest.fixture
def farm(tmp_path: Path) -> Iterator[EmbeddedFarm]:
    with embedded_farm(tmp_path / "farm", [tmp_path], 1, "127.0.0.1:0") as farm:
        yield farm


def render_child(worker: int) -> int:
    """The render process of a worker; its other child keeps multiprocessing's accounts."""
    children = Path(f"/proc/{worker}/task/{worker}/children").read_text().split()
    [child] = [
        pid for pid in children if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]
    return int(child)


def test_a_crashed_attempt_is_told_in_its_frames_log_and_counted(
    farm: EmbeddedFarm, one_frame: Shot
) -> None:
    with Client(farm.url) as client:
        job = client.submit(one_frame).job.id
        end = time.monotonic() + 120
        while not (busy := [w for w in client.workers() if w.task and w.task.kind == "render"]):
            assert time.monotonic() < end
            time.sleep(0.05)
        os.kill(render_child(busy[0].pid), signal.SIGSEGV)
        while not (failed := [line for line in client.log(job, 1) if line.event == "failed"]):
            assert time.monotonic() < end
            time.sleep(0.05)
        client.control(job, "cancel")
    [line] = failed
    assert (line.worker, line.cause, line.attempt) == (busy[0].name, "crash", 1)
    assert line.task.startswith("render")
    assert "signal 11" in (line.reason or "")
    assert "Segmentation fault" in (line.output or "")
    command = [PILEUS, "log", job, "1", "--server", farm.url]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "Segmentation fault" in printed
    assert printed.index("plan") < printed.index("signal 11")
    metrics = httpx.get(f"{farm.url}/metrics").text
    assert 'pileus_attempt_failures_total{cause="crash"} 1.0' in metrics
    assert 'pileus_attempts_total{kind="plan",outcome="done"} 1.0' in metrics


def test_the_metrics_add_up_to_what_was_done(
    farm: EmbeddedFarm, shot: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "caches").mkdir()
    caches = [tmp_path / "caches" / f"cloud.{frame:04d}.vdb" for frame in (1, 2, 3)]
    for frame, path in enumerate(caches, 1):
        core.make_cloud(str(path), frame=frame, frames=3, resolution=48)
    with Client(farm.url) as client:
        *_, job = client.watch(client.submit(Shot.model_validate(shot), priority=3).job.id)
        assert job.state == "done"

        def metric(name: str, **labels: str) -> float:
            told = httpx.get(f"{farm.url}/metrics").text
            return sum(
                sample.value
                for family in text_string_to_metric_families(told)
                for sample in family.samples
                if sample.name == f"pileus_{name}" and labels.items() <= sample.labels.items()
            )

        plans = [plan_of(tmp_path / "farm", job.id, frame) for frame in (1, 2, 3)]
        lines = [line for frame in (1, 2, 3) for line in client.log(job.id, frame)]
    parts = [part for plan in plans for part in plan.parts]
    assert metric("frames_done_total") == 3
    assert metric("samples_total") == sum(part.pixel_samples for part in parts)
    assert metric("tasks_done_total") == len(parts) + 6
    for kind, count in (("plan", 3), ("render", len(parts)), ("merge", 3)):
        assert metric("attempts_total", kind=kind, outcome="done") == count
    assert metric("attempts_total") == len(parts) + 6
    assert metric("attempt_failures_total") == 0
    # One worker reads each cache once, and the next one ahead.
    assert metric("cache_read_bytes_total") == sum(path.stat().st_size for path in caches)
    # The seconds by phase are those of the attempts, told as each ends to the millisecond.
    seconds = sum(line.seconds for line in lines if line.seconds is not None)
    assert metric("phase_seconds_total") == pytest.approx(seconds, abs=0.001 * (len(parts) + 6))
    assert all(
        metric("phase_seconds_total", phase=each) > 0 for each in ("render", "merge", "write")
    )
    core_seconds = metric("threads") * metric("phase_seconds_total")
    assert metric("core_seconds_total") == pytest.approx(core_seconds, rel=1e-3)
    assert metric("cpu_seconds_total") > 0
    assert (metric("tasks_waiting", priority="3"), metric("tasks_held", priority="3")) == (0, 0)
    assert metric("queue_age_seconds", priority="3") == 0
    assert (metric("workers"), metric("workers_busy"), metric("threads_busy")) == (1, 0, 0)


def test_a_render_process_tells_nothing_of_a_task_once_it_has_ended(
    one_frame: Shot, tmp_path: Path
) -> None:
    """What it said later would be taken for the next task's: progress that falls back."""
    job = Job(id="j", created=0, shot=one_frame)
    Store(tmp_path / "data").create(job, Wish())
    setup = child.Setup(
        tmp_path / "data", (tmp_path,), 1, 1 << 28, 1 << 32, 1.0, 60.0, NOWHERE_ELSE
    )
    renderer = Child(setup, Output())
    try:
        while not renderer.ready(1.0):
            pass
        for _ in range(3):
            renderer.order(child.Order(job, 1, Kind.PLAN, 0, read_ahead=False))
            while isinstance(told := renderer.hear(1.0), child.Beat | None):
                pass
            assert isinstance(told, child.Finished)
            assert renderer.hear(5 * child.TICK) is None
    finally:
        renderer.kill()


def test_a_frames_log_is_bounded_and_keeps_the_newest(tmp_path: Path, one_frame: Shot) -> None:
    store = Store(tmp_path / "data")
    store.create(Job(id="j", created=0, shot=one_frame), Wish())
    record = logging.LogRecord("n", logging.INFO, "", 0, "", None, None)
    handler = framelog.FrameLog(store)
    with structlog.contextvars.bound_contextvars(job="j", frame=1, worker="w", task="merge"):
        for number in range(1000):
            record.msg = f"{number} {'x' * 1000}"
            handler.emit(record)
    folder = store.frame("j", 1).logs
    kept = sum(path.stat().st_size for path in folder.iterdir())
    assert kept < 2 * (framelog.FILE_BYTES + 2000)
    (folder / "another.jsonl").symlink_to("gone")  # as one that is turned over amid the look
    lines = framelog.read(folder, 50)
    assert [int(line.event.split()[0]) for line in lines] == list(range(950, 1000))


def test_a_data_folder_that_fails_ends_no_attempt_that_logs(tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    # What a disk says that is ill, root or not: an error, and not "not found".
    (store.jobs_folder / "j").symlink_to("x" * 300)
    with pytest.raises(OSError, match="too long"):
        store.has("j")
    record = logging.LogRecord("n", logging.INFO, "", 0, "begun", None, None)
    with structlog.contextvars.bound_contextvars(job="j", frame=1, worker="w", task="merge"):
        framelog.FrameLog(store).emit(record)


def test_the_workers_log_is_bounded(tmp_path: Path) -> None:
    with (tmp_path / "workers.log").open("ab") as log:
        writer = Workers(["sh", "-c", "while echo line; do sleep 0.01; done"], 1, log)
        try:
            log.truncate(LOG_BYTES + 1)
            writer.keep_up()
            time.sleep(0.3)
        finally:
            writer.end()
    assert (tmp_path / "workers.old.log").stat().st_size > LOG_BYTES
    assert 0 < (tmp_path / "workers.log").stat().st_size < 10_000


def test_redis_log_is_bounded(tmp_path: Path) -> None:
    with PrivateRedis(tmp_path) as redis:
        os.truncate(tmp_path / "redis.log", LOG_BYTES + 1)
        redis.keep_up()
    assert (tmp_path / "redis.old.log").stat().st_size > LOG_BYTES
    assert b"Redis is now ready to exit" in (tmp_path / "redis.log").read_bytes()[:10_000]


@settings(deadline=None)
@given(st.text("prmdfc.", min_size=1, max_size=300))
def test_the_grid_has_a_mark_for_every_frame_in_its_place(states: str) -> None:
    frame_map = FrameMap(frames=f"10-{9 + len(states)}", states=states, width=1, height=1)
    job = JobView(
        id="j", name="n", state=JobState.RUNNING, priority=5, frames=len(states), frames_done=0,
        frames_failed=0, progress=0.0, samples=0, tasks=0, created=0.0,
    )  # fmt: skip
    page = io.StringIO()
    Console(file=page, width=100).print(terminal.job_picture(job, frame_map, [], [], []))
    rows = re.findall(r"^ *(\d+) ([·○◐◕●✗ -]+)$", page.getvalue(), re.MULTILINE)
    assert [int(first) for first, _ in rows] == list(range(10, 10 + len(states), terminal.ROW))
    marks = "".join(marks for _, marks in rows).replace(" ", "")
    assert marks == states.translate(str.maketrans("prmdfc.", "○◐◕●✗-·"))


def test_a_running_job_shows_its_buckets_its_workers_and_the_time_left() -> None:
    doing = Doing(job="j", frame=7, kind=Kind.RENDER, bucket=(0, 32, 64, 96), samples=(8, 16),
                  progress=0.5)  # fmt: skip
    seen = {"host": "h", "pid": 1, "threads": 4, "started": 0.0, "seen": 0.0, "alive": True}
    here = WorkerView(name="cirrus", doing=doing, **seen)
    elsewhere = WorkerView(name="nimbus", doing=doing.model_copy(update={"job": "k"}), **seen)
    active = FrameView(frame=7, state="rendering", tasks=9, tasks_done=4, progress=0.5)
    job = JobView(
        id="j", name="n", state=JobState.RUNNING, priority=5, frames=1, frames_done=0,
        frames_failed=0, progress=0.5, samples=0, tasks=0, created=0.0, seconds_left=3780,
        active=[active],
    )  # fmt: skip
    frame_map = FrameMap(frames="7", states="r", width=64, height=96)
    page = io.StringIO()
    picture = terminal.job_picture(job, frame_map, [], [], [here, elsewhere])
    Console(file=page, width=140).print(picture)
    told = page.getvalue()
    assert "1 h 03 min left" in told
    assert re.search(r"7 +rendering .* 4 of 9", told)
    assert re.search(
        r"cirrus +● at work +4 +render frame 7, pixels 0,32 to 64,96, samples 8 to 16", told
    )
    assert "nimbus" not in told


def test_nothing_of_a_paused_job_is_shown_at_work() -> None:
    active = FrameView(frame=7, state="rendering", tasks=9, tasks_done=4, progress=0.5)
    job = JobView(
        id="j", name="n", state=JobState.PAUSED, priority=5, frames=1, frames_done=0,
        frames_failed=0, progress=0.5, samples=0, tasks=0, created=0.0, active=[active],
    )  # fmt: skip
    page = io.StringIO()
    frame_map = FrameMap(frames="7", states="r", width=64, height=96)
    Console(file=page, width=140).print(terminal.job_picture(job, frame_map, [], [], []))
    assert re.search(r"7 +paused .* 4 of 9", page.getvalue())
    assert "rendering" not in page.getvalue()


NAME = "plume[/wip] [red] :cloud:"


def test_what_others_have_named_is_shown_as_it_is() -> None:
    job = JobView(
        id="j", name=NAME, state=JobState.RUNNING, priority=5, frames=1, frames_done=0,
        frames_failed=1, progress=0.5, samples=0, tasks=0, created=0.0,
    )  # fmt: skip
    seen = {"host": "h", "pid": 1, "threads": 4, "started": 0.0, "seen": 0.0, "alive": True}
    busy = WorkerView(name=NAME, doing=Doing(job="j", frame=1, kind=Kind.MERGE), **seen)
    aside = WorkerView(name="b", aside=NAME, **seen)
    failed = FrameView(frame=1, state="failed", reason=NAME)
    finding = doctor.Finding(level="wrong", what="root", found=NAME, mend=NAME)
    frame_map = FrameMap(frames="1", states="f", width=1, height=1)
    for picture, times in (
        (terminal.job_table([job]), 1),
        (terminal.worker_table([busy, aside], {"j": NAME}), 3),
        (terminal.job_picture(job, frame_map, [failed], [], []), 2),
        (terminal.finding_table([finding]), 2),
    ):
        page = io.StringIO()
        Console(file=page, width=200).print(picture)
        assert page.getvalue().count(NAME) == times


def test_bars_and_notes_show_names_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    screen, keyboard = os.openpty()
    with os.fdopen(keyboard, "w") as terminal_of_a_person:
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setenv("COLUMNS", "200")
        monkeypatch.setattr(sys, "stderr", terminal_of_a_person)
        with Display() as display:
            display.show(Row(f"bar {NAME}", 0.5, ""))
            display.note(f"note {NAME}")
    shown = ""
    with contextlib.suppress(OSError):  # its end is an error: nobody is at the terminal any more
        while True:
            shown += os.read(screen, 1 << 16).decode()
    os.close(screen)
    assert f"bar {NAME}" in shown
    assert f"note {NAME}" in shown


def test_every_line_says_what_it_is_about(capsys: pytest.CaptureFixture[str]) -> None:
    """Those of libraries too, which know nothing of structlog."""
    before = logging.root.handlers[:]
    try:
        logs.configure()
        with structlog.contextvars.bound_contextvars(job="j", frame=3, task="plan", worker="w"):
            structlog.stdlib.get_logger().info("ours", seconds=1.5)
            logging.getLogger("theirs").warning("with %s", "arguments")
    finally:
        logging.root.handlers[:] = before
    ours, theirs = map(json.loads, capsys.readouterr().err.splitlines())
    about = {"job": "j", "frame": 3, "task": "plan", "worker": "w"}
    assert ours.items() >= {**about, "event": "ours", "seconds": 1.5, "level": "info"}.items()
    assert theirs.items() >= {**about, "event": "with arguments", "level": "warning"}.items()
