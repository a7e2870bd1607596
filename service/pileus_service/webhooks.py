"""Webhooks: a word to other programs when a job has ended, after Standard Webhooks 1.0.0.

A notice is a file of the data folder from the moment that its job ends until it is delivered or
given up: a restart loses none, and may tell one twice, under the same id. A user's address must be
of an origin that the farm's keeper has allowed, no redirect is followed and no answer is read, so
the service cannot be made to speak with what only it can reach.
"""

import asyncio
import base64
import binascii
import hashlib
import hmac
import json
import time
from collections.abc import Iterable
from pathlib import Path

import httpx
import structlog
from pydantic import Field, SecretStr, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict
from tenacity import AsyncRetrying, RetryError, retry_if_exception_type, stop_after_delay
from tenacity.wait import wait_random_exponential

from pileus_service import __version__
from pileus_service.errors import InputError
from pileus_service.jobs import Job, Record, Wish
from pileus_service.store import write_whole

log = structlog.stdlib.get_logger(__name__)

LIFETIME = 86400.0
MOST_KEPT = 10_000
AT_ONCE = 8
REASONS_TOLD = 20


class HookSettings(BaseSettings):
    """From the environment: where every job's end is told, which origins users may name (both
    parted by spaces), and the secret that signs, `whsec_` and 24 to 64 bytes in base64."""

    model_config = SettingsConfigDict(env_prefix="PILEUS_WEBHOOK_")
    urls: str = ""
    allow: str = ""
    secret: SecretStr = SecretStr("")
    # The longest pause between two tries grows to at most this many seconds.
    patience: float = Field(default=300.0, gt=0)


class Notice(Record):
    """A word that is still to be delivered."""

    id: str
    url: str
    created: float
    body: str


class RefusedError(Exception):
    """The other side did not take a notice; it may later."""


class Webhooks:
    """The notices of one data folder."""

    def __init__(self, data: Path, settings: HookSettings) -> None:
        self._outbox = data / "outbox"
        self._urls = settings.urls.split()
        self._allowed = {_origin(url, "PILEUS_WEBHOOK_ALLOW") for url in settings.allow.split()}
        for url in self._urls:
            _origin(url, "PILEUS_WEBHOOK_URLS")
        self._secret = b""
        if self._urls or self._allowed:
            self._secret = _decoded(settings.secret.get_secret_value())
        self._patience = settings.patience
        self._in_hand: set[Path] = set()

    def check(self, url: str) -> None:
        """Refuses a user's address that the keeper of the farm has not allowed."""
        if _origin(url, "webhook") not in self._allowed:
            raise InputError(
                f"webhook = {url!r:.200}: this farm may not call there; its keeper allows origins "
                "with PILEUS_WEBHOOK_ALLOW"
            )

    def _may_call(self, url: str) -> bool:
        """Whether the keeper still wants a notice to go there: what was allowed may be no more."""
        try:
            return url in self._urls or _origin(url, "webhook") in self._allowed
        except InputError:
            return False

    def note_end(self, job: Job, wish: Wish) -> None:
        """Keeps a notice of a job's end for each that wants it."""
        theirs = [job.webhook] if job.webhook and self._may_call(job.webhook) else []
        urls = dict.fromkeys([*self._urls, *theirs])
        if not urls:
            return
        if sum(1 for _ in self._files()) >= MOST_KEPT:
            log.error("too many notices are undelivered; this one is dropped", job=job.id)
            return
        numbers = job.shot.frame_numbers
        failed = {numbers[index]: why for index, why in sorted(wish.failed.items())[:REASONS_TOLD]}
        now = time.time()
        body = {
            "type": "job.ended",
            "timestamp": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(now)),
            "data": {
                "id": job.id,
                "name": job.shot.name,
                "state": wish.state,
                "frames": len(numbers),
                "frames_failed": len(wish.failed),
                "failed": failed,
            },
        }
        for url in urls:
            # Several services may see the job end: what they tell is one notice.
            end = f"{job.id} {wish.state} {wish.finished or now} {url}"
            name = f"msg_{hashlib.sha256(end.encode()).hexdigest()[:24]}"
            notice = Notice(id=name, url=url, created=now, body=json.dumps(body))
            write_whole(self._outbox / f"{notice.id}.json", notice.model_dump_json().encode())

    async def deliver(self) -> None:
        """Delivers for ever what there is, a few at once; run as a task of the service."""
        gate = asyncio.Semaphore(AT_ONCE)
        # Neither the environment's proxies nor its passwords are for addresses of users.
        async with (
            httpx.AsyncClient(timeout=10, trust_env=False) as http,
            asyncio.TaskGroup() as tasks,
        ):
            while True:
                for path in set(self._files()) - self._in_hand:
                    self._in_hand.add(path)
                    tasks.create_task(self._see_through(http, gate, path))
                await asyncio.sleep(0.5)

    def _files(self) -> Iterable[Path]:
        return self._outbox.glob("msg_*.json")

    async def _see_through(
        self, http: httpx.AsyncClient, gate: asyncio.Semaphore, path: Path
    ) -> None:
        try:
            notice = Notice.model_validate_json(path.read_bytes())
            if self._may_call(notice.url):
                await self._insist(http, gate, notice)
            else:
                log.error("webhook given up", notice=notice.id, reason="it may not be called")
            path.unlink(missing_ok=True)
        except ValidationError:
            log.error("a notice is spoilt and is dropped", file=path.name)
            path.unlink(missing_ok=True)
        except OSError as error:
            log.warning("a notice waits for the disk", file=path.name, reason=str(error))
        finally:
            self._in_hand.discard(path)

    async def _insist(
        self, http: httpx.AsyncClient, gate: asyncio.Semaphore, notice: Notice
    ) -> None:
        """Delivers a notice, however often it is refused, until it is too old to matter."""
        about = {"notice": notice.id, "url": _origin(notice.url, "webhook")}
        left = notice.created + LIFETIME - time.time()
        try:
            async for attempt in AsyncRetrying(
                retry=retry_if_exception_type((httpx.HTTPError, RefusedError)),
                wait=wait_random_exponential(multiplier=0.5, max=self._patience),
                stop=stop_after_delay(left),
            ):
                with attempt:
                    async with gate:
                        await self._post(http, notice)
            log.info("webhook delivered", **about)
        except RetryError as error:
            reason = str(error.last_attempt.exception())
            log.error("webhook given up", reason=reason, **about)

    async def _post(self, http: httpx.AsyncClient, notice: Notice) -> None:
        at = str(int(time.time()))
        signed = f"{notice.id}.{at}.{notice.body}".encode()
        digest = hmac.new(self._secret, signed, hashlib.sha256).digest()
        headers = {
            "Content-Type": "application/json",
            "User-Agent": f"pileus/{__version__}",
            "webhook-id": notice.id,
            "webhook-timestamp": at,
            "webhook-signature": f"v1,{base64.b64encode(digest).decode()}",
        }
        # Streamed and left unread: an answer of any size costs nothing.
        async with http.stream("POST", notice.url, content=notice.body, headers=headers) as answer:
            if not answer.is_success:
                raise RefusedError(f"answered {answer.status_code}")


def hooks_from_environment(data: Path) -> Webhooks:
    try:
        return Webhooks(data, HookSettings())
    except ValidationError as error:
        [first, *_] = error.errors()
        raise InputError(f"PILEUS_WEBHOOK_{str(first['loc'][0]).upper()}: {first['msg']}") from None


def _origin(url: str, field: str) -> str:
    """Scheme, host and port, by which addresses are allowed."""
    try:
        parsed = httpx.URL(url)
    except httpx.InvalidURL as error:
        raise InputError(f"{field}: {error}; write https://HOST/PATH") from None
    if parsed.scheme not in ("http", "https") or not parsed.host or parsed.userinfo:
        raise InputError(f"{field} = {url!r:.200}: write https://HOST/PATH, without a password")
    port = parsed.port or {"http": 80, "https": 443}[parsed.scheme]
    return f"{parsed.scheme}://{parsed.host}:{port}"


def _decoded(secret: str) -> bytes:
    try:
        key = base64.b64decode(secret.removeprefix("whsec_"), validate=True)
    except binascii.Error:
        key = b""
    if not secret.startswith("whsec_") or not 24 <= len(key) <= 64:
        raise InputError(
            "PILEUS_WEBHOOK_SECRET: webhooks need whsec_ and 24 to 64 bytes in base64; make one "
            'with: echo "whsec_$(openssl rand -base64 32)"'
        )
    return key
