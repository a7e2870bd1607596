"""What killed writers leave in the data folder goes in time, and nothing that lives with it."""

import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from pileus_service.agreement import SWEEP
from pileus_service.app import create_app
from pileus_service.auth import Guard, Role, Tokens
from pileus_service.farm import Farm
from pileus_service.jobs import Job, Wish
from pileus_service.shot import Shot
from pileus_service.store import FrameStore, Store

# Dies by SIGKILL at the n-th call of a function: amid writing a file, or removing a folder.
DYING = """
import os, shutil, signal, sys
from pathlib import Path
from pileus_service.auth import Role, Tokens
from pileus_service.jobs import Job, Wish
from pileus_service.store import Store, write_whole
where, name, count, act, data, job = sys.argv[1:]
left = int(count)
module = {"os": os, "shutil": shutil}[where]
real = getattr(module, name)
def fatal(*arguments, **more):
    global left
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*arguments, **more)
setattr(module, name, fatal)
store = Store(Path(data))
exec(act)
"""
MADE = "store.create(Job.model_validate_json(job).model_copy(update={'id': 'made'}), Wish())"


def killed(data: Path, job: Job, where: str, count: int, act: str) -> None:
    module, _, name = where.partition(".")
    told = [module, name, str(count), act, str(data), job.model_dump_json()]
    ended = subprocess.run([sys.executable, "-c", DYING, *told])
    assert ended.returncode == -signal.SIGKILL


def everything(folder: Path) -> set[Path]:
    return {path.relative_to(folder) for path in folder.rglob("*")}


@pytest.mark.parametrize(
    ("where", "count", "act"),
    [
        ("os.fsync", 1, "store.wish('job', Wish(state='paused'))"),
        ("os.fsync", 1, "Tokens(Path(data)).create('late', Role.READ)"),
        ("os.fsync", 1, "write_whole(Path(data) / 'outbox' / 'msg_1.json', b'{}')"),
        ("os.fsync", 1, MADE),
        ("os.fsync", 3, MADE),
        ("shutil.rmtree", 1, "shutil.rmtree(store.forget('other'))"),
    ],
    ids=["state", "token", "notice", "job half made", "job nearly made", "job half removed"],
)
def test_what_a_killed_writer_left_is_swept_when_a_service_starts(
    farm: Farm, shot: dict[str, Any], where: str, count: int, act: str
) -> None:
    store = farm.store
    jobs = {
        name: Job(id=name, created=time.time(), shot=Shot.model_validate(shot))
        for name in ("job", "other")
    }
    store.begin()
    Tokens(store.root).create("ops", Role.ADMIN)
    (store.root / "outbox").mkdir()
    store.create(jobs["job"], Wish(state="paused"))
    if "forget" in act:
        before = everything(store.root)
    store.create(jobs["other"], Wish(state="paused"))
    if "forget" not in act:
        before = everything(store.root)
    killed(store.root, jobs["job"], where, count, act)
    left = everything(store.root) - before
    assert left
    living = store.root / "jobs" / "job" / ".state.json.1.abcd"  # of a service that is at work
    living.touch()
    long_ago = time.time() - SWEEP - 60
    for path in left:
        os.utime(store.root / path, (long_ago, long_ago))
    with TestClient(create_app(farm, Guard())):
        end = time.monotonic() + 60
        while everything(store.root) & left:
            assert time.monotonic() < end, everything(store.root) & left
            time.sleep(0.05)
        time.sleep(0.2)
    assert everything(store.root) == before | {living.relative_to(store.root)}
    assert store.job("job") == jobs["job"]


def test_while_a_jobs_files_are_removed_nobody_waits_and_one_made_anew_stays(
    farm: Farm, shot: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    store = farm.store
    job = Job(id="job", created=time.time(), shot=Shot.model_validate(shot))
    store.create(job, Wish(state="paused"))
    again = Store(store.root)
    assert farm.job("job")

    def meanwhile(path: Path, ignore_errors: bool = False) -> None:
        assert farm.queue.state("job") is None
        with ThreadPoolExecutor(1) as others:
            assert others.submit(farm.agreement.lock.acquire, timeout=10).result()
        assert again.create(job, Wish())
        monkeypatch.undo()
        shutil.rmtree(path, ignore_errors=ignore_errors)

    monkeypatch.setattr("shutil.rmtree", meanwhile)
    assert farm.remove("job")
    assert store.job("job") == job
    assert store.wished("job") == Wish()


def test_what_cannot_be_swept_fails_no_frame(tmp_path: Path) -> None:
    """As a file that another program holds open on NFS."""
    busy = tmp_path / ".nfs0001"
    busy.mkdir()
    mount = ["mount", "-t", "tmpfs", "none", str(busy)]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("no right to mount a file system")
    try:
        (tmp_path / ".plan.json.1.0").touch()
        FrameStore(tmp_path).sweep()
        assert list(tmp_path.iterdir()) == [busy]
    finally:
        subprocess.run(["umount", str(busy)], check=True)


def test_services_that_begin_a_farm_at_once_agree_on_its_id(tmp_path: Path) -> None:
    """Each would else find another's id in its place, and refuse all work."""
    with ThreadPoolExecutor(8) as pool:
        for number in range(40):
            stores = [Store(tmp_path / str(number)) for _ in range(8)]
            begun = {each.result() for each in [pool.submit(store.begin) for store in stores]}
            assert begun == {stores[0].farm()}
    (stores[0].root / "farm.json").write_text("{")
    assert stores[0].begin() == stores[1].farm()
