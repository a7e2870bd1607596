"""The API's client: what the commands and scripts use."""

import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Self, TypeVar
from urllib.parse import quote

import httpx
from pydantic import BaseModel, TypeAdapter
from tenacity import Retrying, retry_if_exception_type, stop_after_delay, wait_random_exponential

from pileus_service.errors import FarmError, InputError
from pileus_service.framelog import LogLine
from pileus_service.jobs import TERMINAL, FrameMap, FrameView, JobView, WorkerView, new_id
from pileus_service.messages import Accepted, Submission
from pileus_service.shot import Shot

M = TypeVar("M", bound=BaseModel)
T = TypeVar("T")

PAGE = 1000
ANSWER = 30.0  # seconds that the service may take
RESTART = 10.0  # within which a service is back that was started anew


class LostAnswerError(FarmError):
    """The service had the request and its answer did not come: it may have done what was asked."""


class Client:
    """One service; refused requests raise InputError, a silent service FarmError."""

    def __init__(self, server: str, token: str | None = None) -> None:
        self._server = server
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        try:
            self._http = httpx.Client(
                base_url=f"{server.rstrip('/')}/v1", headers=headers, timeout=ANSWER
            )
        except httpx.InvalidURL as error:
            raise InputError(f"--server {server}: {error}; write http://HOST:PORT") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._http.close()

    def submit(
        self,
        shot: Shot,
        priority: int = 5,
        key: str | None = None,
        webhook: str | None = None,
        *,
        wait_for_caches: bool = False,
    ) -> Accepted:
        """Sends a shot; once more where the answer is lost, which under one key is one job."""
        body = Submission(
            shot=shot, priority=priority, webhook=webhook, wait_for_caches=wait_for_caches
        ).model_dump(mode="json")
        headers = {"Idempotency-Key": key or new_id()}

        def send() -> httpx.Response:
            return self._ask("POST", "/jobs", json=body, headers=headers)

        try:
            answer = send()
        except LostAnswerError:
            answer = _insist(send, RESTART)
        return Accepted.model_validate_json(answer.content)

    def jobs(self) -> Iterator[JobView]:
        """All of them, the newest first."""
        return self._pages("/jobs", TypeAdapter(list[JobView]))

    def job(self, job: str) -> JobView:
        return JobView.model_validate_json(self._ask("GET", f"/jobs/{job}").content)

    def frames(self, job: str) -> Iterator[FrameView]:
        return self._pages(f"/jobs/{job}/frames", TypeAdapter(list[FrameView]))

    def frame(self, job: str, index: int) -> FrameView:
        """One frame, by its place in the job."""
        page = {"limit": 1, "offset": index}
        answer = self._ask("GET", f"/jobs/{job}/frames", params=page)
        [frame] = TypeAdapter(list[FrameView]).validate_json(answer.content)
        return frame

    def frame_map(self, job: str) -> FrameMap:
        return FrameMap.model_validate_json(self._ask("GET", f"/jobs/{job}/map").content)

    def log(self, job: str, frame: int) -> list[LogLine]:
        answer = self._ask("GET", f"/jobs/{job}/frames/{frame}/log")
        return TypeAdapter(list[LogLine]).validate_json(answer.content)

    def control(self, job: str, verb: str) -> JobView:
        return JobView.model_validate_json(self._ask("POST", f"/jobs/{job}/{verb}").content)

    def set_priority(self, job: str, priority: int) -> JobView:
        answer = self._ask("PATCH", f"/jobs/{job}", json={"priority": priority})
        return JobView.model_validate_json(answer.content)

    def delete(self, job: str) -> None:
        self._ask("DELETE", f"/jobs/{job}")

    def drain(self, worker: str, *, undo: bool = False) -> None:
        self._ask("POST", f"/workers/{quote(worker, safe='')}/{'undrain' if undo else 'drain'}")

    def workers(self) -> list[WorkerView]:
        return TypeAdapter(list[WorkerView]).validate_json(self._ask("GET", "/workers").content)

    def watch(self, job: str) -> Iterator[JobView]:
        """The job twice a second until it ends; rides out a restart of the service."""
        while True:
            view = _insist(lambda: self.job(job), 120)
            yield view
            if view.state in TERMINAL:
                return
            time.sleep(0.5)

    def _pages(self, path: str, page: TypeAdapter[list[M]]) -> Iterator[M]:
        offset = 0
        while True:
            answer = self._ask("GET", path, params={"limit": PAGE, "offset": offset})
            things = page.validate_json(answer.content)
            yield from things
            if len(things) < PAGE:
                return
            offset += PAGE

    def _ask(self, verb: str, path: str, **more: Any) -> httpx.Response:
        try:
            answer = self._http.request(verb, path, **more)
        except (httpx.InvalidURL, httpx.UnsupportedProtocol) as error:
            raise InputError(f"--server {self._server}: {error}") from None
        except (httpx.ReadTimeout, httpx.ReadError, httpx.RemoteProtocolError) as error:
            late = isinstance(error, httpx.ReadTimeout)
            why = f"did not answer in {ANSWER:g} s" if late else f"broke off ({error})"
            raise LostAnswerError(
                f"{self._server}: the service {why} and may have done what was asked"
            ) from None
        except httpx.TransportError as error:
            raise FarmError(
                f"{self._server}: no service answers ({error}); start one with `pileus up`"
            ) from None
        if answer.is_success:
            return answer
        try:
            detail = answer.json()["detail"]
        except (ValueError, KeyError, TypeError):
            detail = f"answered {answer.status_code}; is this a Pileus service?"
        if answer.is_client_error:
            raise InputError(str(detail))
        raise FarmError(f"{self._server}: {detail}")


def _insist(ask: Callable[[], T], seconds: float) -> T:
    """Asks again for so long where the service fails or is not there."""
    patient = Retrying(
        retry=retry_if_exception_type(FarmError),
        wait=wait_random_exponential(multiplier=0.2, max=5),
        stop=stop_after_delay(seconds),
        reraise=True,
    )
    return patient(ask)
