"""`pileus doctor` on real folders and a real Redis: what is well, and what each wrong thing is."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from redis import Redis

from pileus_service import doctor
from pileus_service.queue import Queue, connect
from pileus_service.store import Store
from pileus_worker.private_redis import PrivateRedis

PILEUS = str(Path(sys.executable).with_name("pileus"))


@pytest.fixture
def own_redis(tmp_path: Path) -> Iterator[Redis]:
    """One that a test may spoil."""
    with PrivateRedis(tmp_path / "redis") as server, connect(server.url) as client:
        yield client


def levels(findings: Iterator[doctor.Finding]) -> dict[str, str]:
    return {finding.what: finding.level for finding in findings}


def test_what_is_well_is_called_well(own_redis: Redis, tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    assert set(levels(doctor.host()).values()) == {"ok"}
    found = levels(doctor.folders(tmp_path / "data", [tmp_path]))  # as `pileus up` has them
    assert (found["data folder"], found["root"]) == ("ok", "ok")
    assert not list((tmp_path / "data").iterdir())
    found = levels(doctor.redis_server(own_redis))
    assert {found["Redis"], found["clock"], found["Redis when it is full"]} == {"ok"}


def test_a_redis_that_may_forget_is_wrong(own_redis: Redis) -> None:
    own_redis.config_set("maxmemory-policy", "allkeys-lru")
    own_redis.config_set("appendonly", "no")
    own_redis.config_set("maxmemory", 1 << 20)
    found = levels(doctor.redis_server(own_redis))
    assert found["Redis when it is full"] == "wrong"
    assert found["Redis's memory of itself"] == "warning"
    assert found["Redis's room"] == "warning"


def test_a_redis_of_another_farm_is_told(own_redis: Redis, tmp_path: Path) -> None:
    store, queue = Store(tmp_path / "data"), Queue(own_redis)
    assert not list(doctor.one_farm(store.root, own_redis)), "no farm has begun"
    assert queue.serves(store.begin())
    assert levels(doctor.one_farm(store.root, own_redis)) == {"data folder and Redis": "ok"}
    assert levels(doctor.one_farm(tmp_path, own_redis)) == {"data folder and Redis": "wrong"}


def test_what_is_not_there_is_named_with_a_mend(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    command = [PILEUS, "doctor", "--json", "--data", str(tmp_path / "file")]
    command += ["--root", str(tmp_path / "none"), "--redis", "unix:///nowhere/redis"]
    command += ["--server", "http://127.0.0.1:1"]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert ended.returncode == 1
    assert ended.stderr.count("\n") == 1
    wrong = {each["what"]: each for each in json.loads(ended.stdout) if each["level"] == "wrong"}
    assert wrong.keys() == {"data folder", "root", "Redis", "service"}
    assert all(each["mend"] for each in wrong.values())
