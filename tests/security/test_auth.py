"""Who gets in: every route against every kind of caller, and what is kept and told of tokens."""

import contextlib
import hashlib
import json
import os
import re
import resource
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient
from redis import Redis
from tenacity import Retrying, retry_if_exception_type, stop_after_delay, wait_fixed
from typer.testing import CliRunner

from pileus_service.app import create_app
from pileus_service.auth import FAILURES_A_MINUTE, Guard, Role, Tokens, guard_for
from pileus_service.commands.token import app as token_app
from pileus_service.errors import InputError
from pileus_service.farm import Farm
from pileus_service.pages import PAGES
from pileus_worker.private_redis import PrivateRedis

PILEUS = str(Path(sys.executable).with_name("pileus"))
FAR = "http://farm.example"
# What a load balancer or a person without a token may see.
OPEN = {"/healthz", "/readyz"}


@pytest.fixture
def tokens(tmp_path: Path) -> Tokens:
    return Tokens(tmp_path / "data")


@pytest.fixture
def app(farm: Farm, tokens: Tokens) -> FastAPI:
    return create_app(farm, Guard(tokens))


@pytest.fixture
def far(app: FastAPI) -> Iterator[TestClient]:
    with TestClient(app, base_url=FAR) as client:
        yield client


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def operations(app: FastAPI) -> list[tuple[str, str]]:
    """Method and path of each operation that the API describes, its parameters filled in."""
    found = []
    for path, methods in app.openapi()["paths"].items():
        filled = re.sub(r"\{frame\}", "1", re.sub(r"\{(?!frame)\w+\}", "nobody", path))
        found += [(method.upper(), filled) for method in methods]
    return found


def needed(method: str, path: str) -> Role:
    if method != "GET" and path.startswith("/v1/workers"):
        return Role.ADMIN
    return {"GET": Role.READ, "DELETE": Role.ADMIN}.get(method, Role.SUBMIT)


def test_every_operation_asks_for_a_token_of_the_right_role(
    app: FastAPI, far: TestClient, tokens: Tokens
) -> None:
    bearers = {role: bearer(tokens.create(role, role)) for role in Role}
    asked = operations(app)
    described = {route.path for route in app.routes if isinstance(route, APIRoute)}
    assert described - PAGES.keys() <= set(app.openapi()["paths"]), (
        "an operation hides from the OpenAPI page"
    )
    assert len(asked) > 10
    for method, path in asked:
        told = far.request(method, path).status_code
        assert told == (200 if path in OPEN else 401), (method, path)
        for role, headers in bearers.items():
            status = far.request(method, path, headers=headers).status_code
            may = path in OPEN or role.may(needed(method, path))
            assert (status not in (401, 403)) == may, (method, path, role, status)


def test_wrong_revoked_mangled_and_foreign_tokens_are_refused(
    far: TestClient, tokens: Tokens, tmp_path: Path
) -> None:
    good = tokens.create("reader", Role.READ)
    other = tokens.create("other", Role.ADMIN)
    name, secret = good.split(".")
    path = "/v1/jobs"
    assert far.get(path, headers=bearer(good)).status_code == 200
    record = json.loads((tmp_path / "data" / "tokens" / "reader.json").read_text())
    wrong = [name, f"{name}.", f".{secret}", f"nobody.{secret}", f"other.{secret}", good + "x"]
    wrong += [f"../{good}", f"{name}.{record['digest']}", record["digest"], other.split(".")[1]]
    for token in wrong:
        assert far.get(path, headers=bearer(token)).status_code == 401, token
    basic = {"Authorization": f"Basic {good}"}
    assert far.get(path, headers=basic).status_code == 401
    assert far.get(path, params={"token": good}).status_code == 401
    tokens.revoke("reader")
    assert far.get(path, headers=bearer(good)).status_code == 401
    again = tokens.create("reader", Role.READ)
    assert far.get(path, headers=bearer(good)).status_code == 401
    assert far.get(path, headers=bearer(again)).status_code == 200
    (tmp_path / "data" / "tokens" / "reader.json").write_text("{")
    assert far.get(path, headers=bearer(again)).status_code == 401


def test_a_comparison_in_constant_time_alone_decides(
    far: TestClient, tokens: Tokens, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For a name that there is not, too: no time tells which names there are."""
    good = tokens.create("reader", Role.READ)
    compared: list[tuple[str, str]] = []

    def never(one: str, other: str) -> bool:
        compared.append((one, other))
        return False

    monkeypatch.setattr("hmac.compare_digest", never)
    for token in (good, "reader.guess", "nobody.guess"):
        assert far.get("/v1/jobs", headers=bearer(token)).status_code == 401
    assert len(compared) == 3
    assert {len(each) for pair in compared for each in pair} == {64}


def test_only_the_hash_is_kept_in_a_folder_of_ones_own(tokens: Tokens, tmp_path: Path) -> None:
    token = tokens.create("ops", Role.ADMIN)
    secret = token.partition(".")[2]
    kept = tmp_path / "data" / "tokens" / "ops.json"
    assert kept.parent.stat().st_mode & 0o077 == 0
    assert secret not in kept.read_text()
    assert hashlib.sha256(secret.encode()).hexdigest() in kept.read_text()
    with pytest.raises(InputError, match="is there already"):
        tokens.create("ops", Role.READ)
    for name in ("", "../ops", "OPS", "a/b", "a" * 65):
        with pytest.raises(InputError, match="a name is of"):
            tokens.create(name, Role.READ)


def test_failed_logins_are_bounded_for_each_address(app: FastAPI, tokens: Tokens) -> None:
    good = tokens.create("ops", Role.ADMIN)
    with (
        TestClient(app, base_url=FAR, client=("192.0.2.7", 1)) as guesser,
        TestClient(app, base_url=FAR, client=("192.0.2.8", 1)) as other,
    ):
        told = [
            guesser.get("/v1/jobs", headers=bearer(f"ops.{n}")).status_code
            for n in range(FAILURES_A_MINUTE + 5)
        ]
        assert told == [401] * FAILURES_A_MINUTE + [429] * 5
        # The right one is no answer either: it would tell a guesser that it is.
        refused = guesser.get("/v1/jobs", headers=bearer(good))
        assert refused.status_code == 429
        assert int(refused.headers["Retry-After"]) > 0
        assert other.get("/v1/jobs", headers=bearer(good)).status_code == 200


def test_addresses_of_one_ipv6_network_count_as_one(app: FastAPI, tokens: Tokens) -> None:
    tokens.create("ops", Role.ADMIN)
    told = []
    for n in range(FAILURES_A_MINUTE + 1):
        client = TestClient(app, base_url=FAR, client=(f"2001:db8::{n:x}", 1))
        told.append(client.get("/v1/jobs", headers=bearer("ops.guess")).status_code)
    assert told == [401] * FAILURES_A_MINUTE + [429]


def test_an_ipv4_address_in_the_clothes_of_ipv6_counts_as_itself(
    app: FastAPI, tokens: Tokens
) -> None:
    """As a proxy may tell it: one guesser must not lock out all others of IPv4."""
    good = tokens.create("ops", Role.ADMIN)
    guesser = TestClient(app, base_url=FAR, client=("::ffff:192.0.2.7", 1))
    for _ in range(FAILURES_A_MINUTE + 1):
        told = guesser.get("/v1/jobs", headers=bearer("ops.guess")).status_code
    assert told == 429
    for address, status in (("::ffff:192.0.2.8", 200), ("192.0.2.7", 429)):
        other = TestClient(app, base_url=FAR, client=(address, 1))
        assert other.get("/v1/jobs", headers=bearer(good)).status_code == status


def test_the_loopback_alone_goes_without_a_token(
    farm: Farm, tokens: Tokens, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="pileus token create"):
        guard_for("0.0.0.0", tmp_path / "data")
    token = tokens.create("ops", Role.ADMIN)
    assert guard_for("0.0.0.0", tmp_path / "data")
    for host in ("127.0.0.1", "localhost", "::1", "127.8.9.1"):
        app = create_app(farm, guard_for(host, tmp_path / "data"))
        near = TestClient(app, base_url="http://127.0.0.1:8765")
        assert near.get("/v1/jobs").status_code == 200
        # A name of another site that was made to mean this address.
        assert TestClient(app, base_url="http://evil.example").get("/v1/jobs").status_code == 403
        # What a proxy here passes on comes from afar.
        for header in ("X-Forwarded-For", "Forwarded"):
            afar = {header: "192.0.2.7"}
            assert near.get("/v1/jobs", headers=afar).status_code == 401
            assert near.get("/v1/jobs", headers=afar | bearer(token)).status_code == 200


def test_no_page_of_another_site_reads_or_writes(farm: Farm, shot: dict[str, Any]) -> None:
    near = TestClient(create_app(farm, Guard()), base_url="http://127.0.0.1:8765")
    own = {"Origin": "http://127.0.0.1:8765"}
    job = near.post("/v1/jobs", json={"shot": shot}, headers=own).json()["job"]["id"]
    for origin in ("http://evil.example", "null", "http://127.0.0.1:80", "http://127.0.0.1"):
        foreign = {"Origin": origin, "Content-Type": "text/plain"}
        for answer in (
            near.get("/v1/jobs", headers=foreign),
            near.post(f"/v1/jobs/{job}/cancel", headers=foreign),
            near.post("/v1/jobs", content=json.dumps({"shot": shot}), headers=foreign),
        ):
            assert answer.status_code == 403
            assert not [name for name in answer.headers if name.startswith("access-control")]
        asked = {"Origin": origin, "Access-Control-Request-Method": "POST"}
        before = near.options("/v1/jobs", headers=asked)
        assert not before.is_success
        assert not [name for name in before.headers if name.startswith("access-control")]
    assert near.get(f"/v1/jobs/{job}").json()["state"] == "queued"


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/jobs/nobody", "/nowhere", "/healthz", "/docs"])
def test_every_answer_has_the_security_headers(farm: Farm, path: str) -> None:
    answer = TestClient(create_app(farm, Guard()), base_url="http://127.0.0.1").get(path)
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    assert answer.headers["X-Frame-Options"] == "DENY"
    assert answer.headers["Cache-Control"] == "no-store"
    assert answer.headers["Referrer-Policy"] == "no-referrer"
    assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
    policy = answer.headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    assert "frame-ancestors 'none'" in policy
    assert "http" not in policy
    assert "unsafe" not in policy
    assert ("script-src" in policy) == (path == "/docs")


def test_an_unforeseen_error_tells_nothing_and_has_the_headers(
    farm: Farm, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise KeyError("the secret of the house")

    monkeypatch.setattr(farm, "jobs", broken)
    app = create_app(farm, Guard())
    client = TestClient(app, base_url="http://127.0.0.1", raise_server_exceptions=False)
    answer = client.get("/v1/jobs")
    assert answer.status_code == 500
    assert "secret" not in answer.text
    assert answer.headers["X-Content-Type-Options"] == "nosniff"


def test_many_submissions_at_once_with_one_key_make_one_job(
    farm: Farm, shot: dict[str, Any]
) -> None:
    near = TestClient(create_app(farm, Guard()), base_url="http://127.0.0.1")

    def post(_: int) -> httpx.Response:
        answer: httpx.Response = near.post(
            "/v1/jobs", json={"shot": shot}, headers={"Idempotency-Key": "k"}
        )
        return answer

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(post, range(24)))
    told = sorted((answer.status_code, answer.text) for answer in answers)
    assert [status for status, _ in told] == [200] * 23 + [201], told[-1]
    assert len({answer.json()["job"]["id"] for answer in answers}) == 1
    assert len(near.get("/v1/jobs").json()) == 1


def token_command(data: Path, *arguments: str) -> str:
    ended = CliRunner().invoke(token_app, [*arguments, "--data", str(data)])
    assert ended.exit_code == 0, ended.output
    return ended.stdout.strip()


def test_the_token_commands(tmp_path: Path) -> None:
    token = token_command(tmp_path, "create", "artist", "--role", "read")
    assert Tokens(tmp_path).bearer(token)
    [listed] = json.loads(token_command(tmp_path, "list", "--json"))
    assert listed.keys() == {"name", "role", "created"}
    assert (listed["name"], listed["role"]) == ("artist", "read")
    token_command(tmp_path, "revoke", "artist")
    assert token_command(tmp_path, "list") == ""
    with pytest.raises(InputError, match="there is none"):
        Tokens(tmp_path).revoke("artist")


def service(data: Path, listen: str, redis: str) -> list[str]:
    return [PILEUS, "service", "--listen", listen, "--data", str(data), "--redis", redis]


@pytest.mark.parametrize(
    ("scheme", "said"), [("redis", "pileus token create"), ("htp", "write redis://HOST:PORT/0")]
)
def test_a_service_that_cannot_start_says_why_and_no_password(
    tmp_path: Path, scheme: str, said: str
) -> None:
    command = service(tmp_path, "0.0.0.0:0", f"{scheme}://user:redispassword@host")
    if scheme == "htp":
        Tokens(tmp_path).create("ops", Role.ADMIN)
    ended = subprocess.run(command, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert said in ended.stderr
    assert "redispassword" not in ended.stderr


def test_a_real_service_takes_tokens_as_they_come_and_logs_none(
    tmp_path: Path, redis: Redis, private_redis: PrivateRedis
) -> None:
    data, log = tmp_path / "data", tmp_path / "log"
    with socket.create_server(("0.0.0.0", 0)) as free:
        port = free.getsockname()[1]
    redis.acl_setuser("farm", enabled=True, passwords=["+redispassword"], keys=["*"],
                      channels=["*"], categories=["+@all"])  # fmt: skip
    guarded = private_redis.url.replace("unix://", "unix://farm:redispassword@")
    tokens = Tokens(data)
    token = tokens.create("artist", Role.SUBMIT)
    with log.open("w") as out:
        command = service(data, f"0.0.0.0:{port}", guarded)
        process = subprocess.Popen(command, stdout=out, stderr=out, cwd=tmp_path)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}") as client:
            for attempt in Retrying(
                retry=retry_if_exception_type(httpx.TransportError),
                stop=stop_after_delay(30),
                wait=wait_fixed(0.1),
            ):
                with attempt:
                    client.get("/healthz")
            assert client.get("/v1/workers").status_code == 401
            seen = client.get("/v1/workers", headers=bearer(token))
            assert seen.status_code == 200
            assert "server" not in seen.headers
            assert client.delete("/v1/jobs/nobody", headers=bearer(token)).status_code == 403
            assert client.get("/v1/workers", headers=bearer(token + "x")).status_code == 401
            assert client.post("/v1/jobs", headers=bearer(token), content=token).is_client_error
            later = tokens.create("later", Role.READ)
            assert client.get("/v1/workers", headers=bearer(later)).status_code == 200
            tokens.revoke("artist")
            assert client.get("/v1/workers", headers=bearer(token)).status_code == 401
            redis.acl_deluser("farm")
            assert client.get("/v1/workers", headers=bearer(later)).status_code == 503
            for attempt in Retrying(stop=stop_after_delay(10), wait=wait_fixed(0.1)):
                with attempt:
                    assert log.stat().st_size > 0, "it complains of Redis"
    finally:
        process.terminate()
        process.wait(20)
    secrets = [each.partition(".")[2] for each in (token, later)]
    for file in [log, *(path for path in data.rglob("*") if path.is_file())]:
        text = file.read_text()
        assert not [secret for secret in (*secrets, "redispassword") if secret in text], file


def test_callers_who_say_nothing_keep_nobody_out(
    tmp_path: Path, redis: Redis, private_redis: PrivateRedis
) -> None:
    """Each costs a file, of which a program has at first far fewer than the system would give."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    files, most = 256, resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    process = subprocess.Popen(
        service(tmp_path / "data", f"127.0.0.1:{port}", private_redis.url),
        cwd=tmp_path,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (files, most)),
    )
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}") as client:
            for attempt in Retrying(stop=stop_after_delay(60), wait=wait_fixed(0.1)):
                with attempt:
                    client.get("/healthz")
        with contextlib.ExitStack() as silent:
            for _ in range(files):
                silent.enter_context(socket.create_connection(("127.0.0.1", port)))
            answer = httpx.get(f"http://127.0.0.1:{port}/v1/jobs", timeout=10)
            assert answer.status_code == 200
    finally:
        process.terminate()
        process.wait(20)


def test_a_worker_that_redis_refuses_logs_no_password(
    tmp_path: Path, private_redis: PrivateRedis
) -> None:
    guarded = private_redis.url.replace("unix://", "unix://nobody:redispassword@")
    command = [PILEUS, "worker", "--data", str(tmp_path / "data"), "--root", str(tmp_path)]
    log = tmp_path / "log"
    with log.open("w") as out:
        env = {**os.environ, "PILEUS_REDIS": guarded}
        process = subprocess.Popen(command, stdout=out, stderr=out, env=env)
    try:
        for attempt in Retrying(stop=stop_after_delay(30), wait=wait_fixed(0.1)):
            with attempt:
                assert "no tasks to be had" in log.read_text()
    finally:
        process.terminate()
        process.wait(20)
    assert "redispassword" not in log.read_text()
