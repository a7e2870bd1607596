"""The HTTP API: thin routes over the farm. Errors are problem documents, see `problems`."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import structlog
from fastapi import APIRouter, Depends, FastAPI, Header, Query, Response
from fastapi import Path as PathParam
from fastapi.responses import FileResponse, PlainTextResponse
from pydantic import BaseModel, Field
from redis.exceptions import RedisError
from sse_starlette import EventSourceResponse
from starlette.concurrency import run_in_threadpool
from starlette.types import Receive, Scope, Send

from pileus_service import __version__, framelog, metrics, pages, problems
from pileus_service.auth import Guard
from pileus_service.broadcast import Broadcast
from pileus_service.errors import ForeignError, InputError
from pileus_service.farm import ConflictError, Farm
from pileus_service.headers import SecurityHeaders
from pileus_service.jobs import JOB_ID, FrameMap, FrameView, JobView, WorkerView
from pileus_service.messages import Accepted, Change, Submission
from pileus_service.problems import Problem
from pileus_service.roots import Roots

log = structlog.stdlib.get_logger(__name__)

MAX_BODY = 1 << 20
T = TypeVar("T")

Id = Annotated[str, PathParam(pattern=f"^{JOB_ID.pattern}$")]
WorkerName = Annotated[str, PathParam(min_length=1, max_length=200)]
FrameNumber = Annotated[int, PathParam(ge=0, le=999_999_999)]
Limit = Annotated[int, Query(ge=1, le=1000)]
Offset = Annotated[int, Query(ge=0, le=1_000_000)]
Key = Annotated[str | None, Header(min_length=1, max_length=200, alias="Idempotency-Key")]


class Health(BaseModel):
    status: Literal["ok"] = "ok"
    version: str = Field(default=__version__)


def create_app(farm: Farm, guard: Guard) -> FastAPI:
    """The app over a farm; a background task keeps Redis true to the disk."""

    async def keep_true() -> None:
        while True:
            try:
                await run_in_threadpool(farm.agreement.reconcile)
            except (RedisError, OSError, ForeignError) as error:
                log.warning("cannot reconcile yet", reason=str(error))
            await asyncio.sleep(1)

    async def for_ever(work: Callable[[], Awaitable[None]]) -> None:
        """Begins work again whatever ends it: without it the service would answer, and no more."""
        while True:
            try:
                await work()
            except Exception:
                log.exception("the service's own work failed; it begins again")
            await asyncio.sleep(1)

    broadcast = Broadcast(farm)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        works = (keep_true, broadcast.run, farm.hooks.deliver)
        tasks = [asyncio.create_task(for_ever(work)) for work in works]
        yield
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    app = FastAPI(
        title="Pileus", version=__version__, lifespan=lifespan, docs_url=None, redoc_url=None
    )
    problems.install(app)
    app.add_middleware(problems.BodyLimit, limit=MAX_BODY)
    app.add_middleware(SecurityHeaders)
    pages.install(app)
    app.include_router(_jobs(farm, broadcast), prefix="/v1", dependencies=[Depends(guard)])

    @app.get(
        "/v1/workers", dependencies=[Depends(guard)], tags=["farm"], responses=problems.GUARDED
    )
    def workers() -> list[WorkerView]:
        return farm.workers()

    @app.post(
        "/v1/workers/{name}/{verb}",
        status_code=204,
        dependencies=[Depends(guard)],
        tags=["farm"],
        responses=problems.RESPONSES,
    )
    def steer(name: WorkerName, verb: Literal["drain", "undrain"]) -> None:
        """Drained, a worker gets no more tasks and finishes what it has in hand; undrained, it gets
        tasks again, also where it was set aside."""
        _found(name in farm.queue.worker_names() or None, f"worker {name}")
        getattr(farm.queue, verb)(name)

    @app.get(
        "/metrics",
        dependencies=[Depends(guard)],
        tags=["farm"],
        response_class=PlainTextResponse,
        responses=problems.GUARDED,
    )
    def prometheus() -> Response:
        told = metrics.exposition(farm.queue, farm.agreement.states())
        return Response(told, media_type="text/plain; version=0.0.4")

    @app.get("/healthz", tags=["farm"])
    def healthy() -> Health:
        return Health()

    @app.get("/readyz", tags=["farm"], responses=problems.responses(503))
    def ready() -> Health:
        farm.agreement.check()
        return Health()

    return app


def _jobs(farm: Farm, broadcast: Broadcast) -> APIRouter:
    router = APIRouter(prefix="/jobs", tags=["jobs"], responses=problems.RESPONSES)

    @router.post(
        "", status_code=201, responses={200: {"model": Accepted, "description": "Is there already"}}
    )
    def submit(body: Submission, response: Response, idempotency_key: Key = None) -> Accepted:
        """Takes a shot. The same Idempotency-Key with the same shot is the same job."""
        try:
            job, new = farm.submit(
                body.shot, body.priority, idempotency_key, body.webhook, body.wait_for_caches
            )
        except ConflictError as error:
            raise Problem(409, str(error)) from None
        if not new:
            response.status_code = 200
        response.headers["Location"] = f"/v1/jobs/{job.id}"
        return Accepted(job=job, warnings=body.shot.warnings())

    @router.get("")
    def jobs(limit: Limit = 100, offset: Offset = 0) -> list[JobView]:
        """The newest first."""
        return farm.jobs(limit, offset)

    @router.get("/{job_id}")
    def job(job_id: Id) -> JobView:
        return _found(farm.job(job_id), job_id)

    @router.get("/{job_id}/frames")
    def frames(job_id: Id, limit: Limit = 100, offset: Offset = 0) -> list[FrameView]:
        return _found(farm.frames(job_id, limit, offset), job_id)

    @router.get("/{job_id}/map")
    def frame_map(job_id: Id) -> FrameMap:
        """The state of every frame, a letter each."""
        return _found(farm.frame_map(job_id), job_id)

    @router.get("/{job_id}/frames/{frame}/preview.png", response_class=_Preview)
    def preview(job_id: Id, frame: FrameNumber) -> FileResponse:
        _found(farm.done(job_id, frame), f"{job_id}, frame {frame}")
        path = farm.store.frame(job_id, frame).preview
        if not path.is_file():
            raise Problem(404, f"{path.name} is gone from the disk")
        return _Preview(path, filename=path.name)

    @router.get("/{job_id}/frames/{frame}/image.exr", response_class=_Image)
    def image(job_id: Id, frame: FrameNumber) -> FileResponse:
        done = _found(farm.done(job_id, frame), f"{job_id}, frame {frame}")
        return _image(farm.roots, Path(done.file))

    @router.get("/{job_id}/frames/{frame}/log")
    def frame_log(job_id: Id, frame: FrameNumber, limit: Limit = 1000) -> list[framelog.LogLine]:
        """The last lines of every attempt at a frame's tasks, in the order of their time."""
        if not farm.store.has(job_id):
            raise Problem(404, f"No {job_id} here")
        return framelog.read(farm.store.frame(job_id, frame).logs, limit)

    @router.post("/{job_id}/cancel")
    def cancel(job_id: Id) -> JobView:
        return _found(farm.control(job_id, "cancel"), job_id)

    @router.post("/{job_id}/pause")
    def pause(job_id: Id) -> JobView:
        return _found(farm.control(job_id, "pause"), job_id)

    @router.post("/{job_id}/resume")
    def resume(job_id: Id) -> JobView:
        return _found(farm.control(job_id, "resume"), job_id)

    @router.post("/{job_id}/retry")
    def retry(job_id: Id) -> JobView:
        """Renders the failed frames again, and no others."""
        return _found(farm.control(job_id, "retry"), job_id)

    @router.patch("/{job_id}")
    def change(job_id: Id, body: Change) -> JobView:
        return _found(farm.control(job_id, "priority", body.priority), job_id)

    @router.delete("/{job_id}", status_code=204)
    def remove(job_id: Id) -> None:
        """Cancels the job and forgets it; its images stay."""
        _found(farm.remove(job_id) or None, job_id)

    @router.get("/{job_id}/events", response_class=EventSourceResponse)
    async def events(job_id: Id) -> EventSourceResponse:
        """The job each time it changes, until it ends."""
        view = _found(await run_in_threadpool(farm.job, job_id), job_id)
        return EventSourceResponse(broadcast.events(view))

    return router


def _found(thing: T | None, name: str) -> T:
    if thing is None:
        raise Problem(404, f"No {name} here")
    return thing


class _Preview(FileResponse):
    """A preview of the data folder."""

    media_type = "image/png"


class _Image(FileResponse):
    """An image under the roots, held open from the check until it is sent."""

    media_type = "image/x-exr"
    held: contextlib.ExitStack

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self.held:
            await super().__call__(scope, receive, send)


def _image(roots: Roots, path: Path) -> _Image:
    held = contextlib.ExitStack()
    try:
        location = held.enter_context(roots.reading(path))
    except InputError as error:
        raise Problem(404, str(error)) from None
    answer = _Image(location, media_type=_Image.media_type, filename=path.name)
    answer.held = held
    return answer
