"""A word when a job is done: told to a real server, checked by the specification's own library."""

import contextlib
import json
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from pydantic import SecretStr
from redis import Redis
from standardwebhooks import Webhook

from pileus_service import webhooks
from pileus_service.app import create_app
from pileus_service.auth import Guard
from pileus_service.errors import InputError
from pileus_service.farm import Farm
from pileus_service.queue import Queue
from pileus_service.roots import Roots
from pileus_service.store import Store
from pileus_service.webhooks import HookSettings, Notice, Webhooks

SECRET = "whsec_C2FVsBQIhrscChlQIMV+b5sSYspob7oD"


class Listener(ThreadingHTTPServer):
    """Answers what it is told to, then 204; keeps what it was sent."""

    def __init__(self, *answers: int) -> None:
        super().__init__(("127.0.0.1", 0), Ear)
        self.answers = list(answers)
        self.heard: list[tuple[str, dict[str, str], bytes]] = []
        self.pause = 0.0
        self.now = self.most = 0  # that it is told at once
        self.counting = threading.Lock()
        self.url = f"http://127.0.0.1:{self.server_address[1]}"


class Ear(BaseHTTPRequestHandler):
    server: Listener

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        with self.server.counting:
            self.server.now += 1
            self.server.most = max(self.server.most, self.server.now)
        time.sleep(self.server.pause)
        with self.server.counting:
            self.server.now -= 1
        self.server.heard.append((self.path, dict(self.headers), body))
        self.send_response(self.server.answers.pop(0) if self.server.answers else 204)
        self.send_header("Location", f"{self.server.url}/elsewhere")
        self.end_headers()

    def log_message(self, *_: Any) -> None:
        pass


@contextlib.contextmanager
def listening(*answers: int) -> Iterator[Listener]:
    with Listener(*answers) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture
def caches(tmp_path: Path) -> None:
    (tmp_path / "caches").mkdir()
    for frame in (1, 2, 3):
        (tmp_path / "caches" / f"cloud.{frame:04d}.vdb").touch()


def service(
    redis: Redis, tmp_path: Path, urls: str = "", allow: str = "", secret: str = SECRET
) -> TestClient:
    data = tmp_path / "data"
    settings = HookSettings(urls=urls, allow=allow, secret=SecretStr(secret), patience=0.1)
    hooks = Webhooks(data, settings)
    farm = Farm(Store(data), Queue(redis), Roots([tmp_path]), hooks)
    return TestClient(create_app(farm, Guard(None)), base_url="http://127.0.0.1")


def send(client: TestClient, shot: dict[str, Any], **more: str) -> str:
    answer = client.post("/v1/jobs", json={"shot": shot, **more})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["job"]["id"])


def until(heard: list[Any], count: int) -> None:
    end = time.monotonic() + 60
    while len(heard) < count:
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.usefixtures("caches")
def test_a_jobs_end_is_told_signed_until_it_is_heard(
    redis: Redis, tmp_path: Path, shot: dict[str, Any]
) -> None:
    with listening(500, 302) as ear:
        with service(redis, tmp_path, urls=f"{ear.url}/hook") as client:
            job = send(client, shot)
            client.post(f"/v1/jobs/{job}/cancel")
            until(ear.heard, 3)
            time.sleep(0.3)
        assert [path for path, _, _ in ear.heard] == ["/hook"] * 3  # no redirect was followed
        assert len({headers["webhook-id"] for _, headers, _ in ear.heard}) == 1
        for _, headers, body in ear.heard:
            told = Webhook(SECRET).verify(body, headers)
        assert told == json.loads(body)
        assert (told["type"], told["data"]["id"]) == ("job.ended", job)
        assert told["data"]["state"] == "cancelled"
        assert not list((tmp_path / "data" / "outbox").iterdir())


@pytest.mark.usefixtures("caches")
def test_a_restart_loses_no_notice(redis: Redis, tmp_path: Path, shot: dict[str, Any]) -> None:
    with listening() as ear:
        asleep = service(redis, tmp_path, allow=ear.url)  # its tasks do not run: nothing is sent
        job = send(asleep, shot, webhook=f"{ear.url}/mine")
        asleep.post(f"/v1/jobs/{job}/cancel")
        assert not ear.heard
        with service(redis, tmp_path, allow=ear.url):
            until(ear.heard, 1)
        assert Webhook(SECRET).verify(ear.heard[0][2], ear.heard[0][1])["data"]["id"] == job


@pytest.mark.usefixtures("caches")
def test_notices_are_bounded_in_number_at_once_and_in_time(
    redis: Redis, tmp_path: Path, shot: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webhooks, "MOST_KEPT", 30)
    with listening() as ear:
        ear.pause = 0.2
        asleep = service(redis, tmp_path, urls=f"{ear.url}/hook")
        for _ in range(31):
            asleep.post(f"/v1/jobs/{send(asleep, shot)}/cancel")
        kept = sorted((tmp_path / "data" / "outbox").iterdir())
        assert len(kept) == 30, "one more than may wait is dropped"
        old = Notice.model_validate_json(kept[0].read_bytes())
        aged = old.model_copy(update={"created": time.time() - webhooks.LIFETIME})
        kept[0].write_text(aged.model_copy(update={"url": "http://127.0.0.1:9/"}).model_dump_json())
        with service(redis, tmp_path, urls=f"{ear.url}/hook", allow="http://127.0.0.1:9"):
            until(ear.heard, 29)
            end = time.monotonic() + 60
            while any((tmp_path / "data" / "outbox").iterdir()):
                assert time.monotonic() < end, "what is too old is given up"
                time.sleep(0.05)
        assert 1 < ear.most <= webhooks.AT_ONCE


@pytest.mark.usefixtures("caches")
@pytest.mark.parametrize(
    "url",
    [
        "http://169.254.169.254/latest/meta-data",
        "http://127.0.0.1:6379/",
        "https://hooks.studio.example:8443/a",
        "http://hooks.studio.example/a",
        "https://user@hooks.studio.example/a",
        "https://hooks.studio.example.evil.example/a",
        "https://hooks.studio.example@evil.example/a",
        "https://evil.example/?https://hooks.studio.example",
        "file:///etc/passwd",
        "gopher://hooks.studio.example/",
        "hooks.studio.example",
        "http://[::1",
    ],
)
def test_users_cannot_make_the_service_call_where_its_keeper_has_not_allowed(
    redis: Redis, tmp_path: Path, shot: dict[str, Any], url: str
) -> None:
    client = service(redis, tmp_path, allow="https://hooks.studio.example")
    answer = client.post("/v1/jobs", json={"shot": shot, "webhook": url})
    assert answer.status_code == 422
    assert "webhook" in answer.json()["detail"]
    assert send(client, shot, webhook="https://HOOKS.studio.example:443/a?b=c")


@pytest.mark.usefixtures("caches")
@pytest.mark.parametrize("when", ["before it ends", "after it has ended"])
def test_an_address_that_is_allowed_no_more_is_called_no_more(
    redis: Redis, tmp_path: Path, shot: dict[str, Any], when: str
) -> None:
    with listening() as ear, listening() as other:
        asleep = service(redis, tmp_path, allow=ear.url)
        job = send(asleep, shot, webhook=f"{ear.url}/mine")
        if when == "after it has ended":
            asleep.post(f"/v1/jobs/{job}/cancel")
        with service(redis, tmp_path, urls=f"{other.url}/all") as client:
            if when == "before it ends":
                client.post(f"/v1/jobs/{job}/cancel")
            else:
                client.post(f"/v1/jobs/{send(client, shot)}/cancel")
            until(other.heard, 1)
            end = time.monotonic() + 60
            while any((tmp_path / "data" / "outbox").iterdir()):
                assert time.monotonic() < end
                time.sleep(0.05)
        assert not ear.heard


@pytest.mark.usefixtures("caches")
def test_a_spoilt_notice_holds_up_no_other(
    redis: Redis, tmp_path: Path, shot: dict[str, Any]
) -> None:
    outbox = tmp_path / "data" / "outbox"
    outbox.mkdir(parents=True)
    (outbox / "msg_cut.json").write_text('{"id": "msg_')
    wrong = Notice(id="msg_odd", url="gopher://[", created=time.time(), body="{}")
    (outbox / "msg_odd.json").write_text(wrong.model_dump_json())
    with listening() as ear, service(redis, tmp_path, urls=f"{ear.url}/hook") as client:
        time.sleep(1)
        client.post(f"/v1/jobs/{send(client, shot)}/cancel")
        until(ear.heard, 1)
        end = time.monotonic() + 60
        while any(outbox.glob("*.json")):
            assert time.monotonic() < end
            time.sleep(0.05)


def test_webhooks_without_a_good_secret_are_refused_at_the_start(
    redis: Redis, tmp_path: Path
) -> None:
    for secret in ("", "whsec_", "whsec_c2hvcnQ=", SECRET.removeprefix("whsec_"), "whsec_%"):
        with pytest.raises(InputError, match="PILEUS_WEBHOOK_SECRET"):
            service(redis, tmp_path, urls="https://hooks.studio.example/a", secret=secret)
    with pytest.raises(InputError, match="PILEUS_WEBHOOK_URLS"):
        service(redis, tmp_path, urls="ftp://hooks.studio.example/a")
