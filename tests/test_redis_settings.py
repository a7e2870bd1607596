"""deploy/redis.conf: the farm's user may do what the farm does and nothing else, behind TLS."""

import hashlib
import re
import subprocess
import time
from pathlib import Path

import pytest
from redis import Redis
from redis.exceptions import NoPermissionError, RedisError

from hosts import free_port, process, until
from pileus_service.jobs import Wish, WorkerInfo
from pileus_service.queue import Queue, connect
from pileus_worker.private_redis import NO_PASSWORD_FITS, PrivateRedis

ROOT = Path(__file__).parent.parent
SETTINGS = (ROOT / "deploy" / "redis.conf").read_text()
QUEUE = ROOT / "service" / "pileus_service"
WORKER = WorkerInfo(name="a", host="host", pid=1, threads=1, started=0.0)
# Sent by the client library itself as it connects and as it runs a script.
CONNECTING = {"client|setname", "select", "ping", "evalsha", "script|load"}


def granted() -> set[str]:
    [user] = [line for line in SETTINGS.splitlines() if line.startswith("user ")]
    return set(re.findall(r" \+(\S+)", user))


def used_by_scripts() -> set[str]:
    scripts = "".join(path.read_text() for path in (QUEUE / "lua").glob("*.lua"))
    calls = re.findall(r"redis\.p?call\('(\w+)'(?:, '(CREATE|GROUPS)')?", scripts)
    assert len(calls) == scripts.count("redis.call(")
    return {"|".join(filter(None, words)).lower() for words in calls}


def test_the_farms_user_may_run_what_the_scripts_run_and_what_the_queue_asks() -> None:
    assert used_by_scripts() <= granted()
    modules = "".join(path.read_text() for path in QUEUE.glob("*.py"))
    asked = set(re.findall(r"redis\.([a-z_]+)\(", modules))
    methods = {"del": "delete", "xgroup|delconsumer": "xgroup_delconsumer"}
    unused = granted() - used_by_scripts() - CONNECTING
    assert {methods.get(name, name) for name in unused} <= asked


@pytest.mark.parametrize(
    "command",
    [
        ["FLUSHALL"],
        ["CONFIG", "GET", "*"],
        ["KEYS", "*"],
        ["GET", "another"],
        ["SUBSCRIBE", "x"],
        ["ACL", "LIST"],
        ["SHUTDOWN"],
        ["SCRIPT", "KILL"],
        ["EVAL", "return redis.call('CONFIG', 'GET', '*')", "0"],
    ],
)
def test_the_farms_user_may_do_nothing_else(
    private_redis: PrivateRedis, command: list[str]
) -> None:
    with connect(private_redis.farm_url) as farm, pytest.raises(NoPermissionError):
        farm.execute_command(*command)


def test_redis_keeps_what_it_must(redis: Redis) -> None:
    kept = redis.config_get("append*", "maxmemory-policy", "maxmemory")
    assert kept["appendonly"] == "yes"
    assert kept["maxmemory-policy"] == "noeviction"
    assert int(kept["maxmemory"] or 0) > 0


def test_a_full_redis_refuses_and_forgets_nothing(redis: Redis, redis_url: str) -> None:
    queue = Queue(connect(redis_url))
    queue.submit("job", "job", time.time(), 1, Wish())
    redis.config_set("maxmemory", "1mb")
    try:
        with pytest.raises(RedisError):
            queue.submit("another", "another", time.time(), 1, Wish())
        assert queue.job_ids(10) == ["job"]
    finally:
        redis.config_set("maxmemory", "1gb")
    task = queue.claim(WORKER)
    assert task and task.job == "job"


@pytest.mark.slow
def test_over_the_network_only_the_farms_user_gets_in_and_only_encrypted(tmp_path: Path) -> None:
    tls = tmp_path / "tls"
    tls.mkdir()
    certify = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2"
    certify += " -subj /CN=localhost -addext subjectAltName=DNS:localhost"
    files = ["-keyout", str(tls / "redis.key"), "-out", str(tls / "redis.crt")]
    subprocess.run([*certify.split(), *files], check=True, capture_output=True)
    (tls / "ca.crt").write_bytes((tls / "redis.crt").read_bytes())
    digest = hashlib.sha256(b"a secret").hexdigest()
    (tmp_path / "redis.conf").write_text(SETTINGS.replace(NO_PASSWORD_FITS, f"#{digest}"))
    network = (ROOT / "deploy" / "redis-network.conf").read_text()
    port = free_port()
    (tmp_path / "redis-network.conf").write_text(
        network.replace("/etc/pileus", str(tmp_path))
        .replace("/var/lib/pileus-redis", str(tmp_path))
        .replace("6379", str(port))
    )
    right = f"rediss://pileus:a%20secret@localhost:{port}/0?ssl_ca_certs={tls / 'ca.crt'}"
    log = tmp_path / "redis.log"
    with process(log, "redis-server", tmp_path / "redis-network.conf"):
        until(lambda: "Ready to accept" in log.read_text(), 20)
        queue = Queue(connect(right))
        queue.submit("job", "job", time.time(), 1, Wish())
        task = queue.claim(WORKER)
        assert task and task.job == "job"
        for wrong in (
            right.replace("pileus:a%20secret@", ""),
            right.replace("secret", "guess"),
            right.replace("rediss", "redis").partition("?")[0],
            right.partition("?")[0],
        ):
            with pytest.raises(RedisError):
                Redis.from_url(wrong).ping()
