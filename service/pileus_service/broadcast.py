"""One look at the farm for all who listen: jobs that are watched are read together, twice a second,
so that listeners cost a queue each and Redis nothing."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

from redis.exceptions import RedisError
from starlette.concurrency import run_in_threadpool

from pileus_service.farm import Farm
from pileus_service.jobs import TERMINAL, JobView

EVERY = 0.5


@dataclass
class _Watched:
    """A job that somebody listens to: what was said of it last, and who waits for more."""

    listeners: int = 0
    said: JobView | None = None
    gone: bool = False
    news: asyncio.Event = field(default_factory=asyncio.Event)


class Broadcast:
    """The changes of jobs, each read once however many listen."""

    def __init__(self, farm: Farm) -> None:
        self._farm = farm
        self._watched: dict[str, _Watched] = {}

    async def run(self) -> None:
        """Reads and tells, for as long as the service lives."""
        while True:
            with contextlib.suppress(RedisError, OSError):  # an absence is ridden out
                await self._look()
            await asyncio.sleep(EVERY)

    async def _look(self) -> None:
        ids = list(self._watched)
        if not ids:
            return
        views = await run_in_threadpool(self._farm.views, ids)
        for job_id, view in zip(ids, views, strict=True):
            watched = self._watched.get(job_id)
            if watched is None:
                continue
            if view is None or watched.said is None or _steady(view) != _steady(watched.said):
                watched.said, watched.gone = view, view is None
                watched.news.set()
                watched.news = asyncio.Event()

    async def changes(self, job: JobView) -> AsyncIterator[JobView]:
        """The job now, then each time it changes, until it ends or is removed."""
        watched = self._watched.setdefault(job.id, _Watched())
        watched.listeners += 1
        try:
            yield job
            while job.state not in TERMINAL:
                news = watched.news
                if watched.said is not None and _steady(watched.said) != _steady(job):
                    job = watched.said
                    yield job
                elif watched.gone:
                    return
                else:
                    await news.wait()
        finally:
            watched.listeners -= 1
            if watched.listeners == 0 and self._watched.get(job.id) is watched:
                del self._watched[job.id]


def _steady(view: JobView) -> JobView:
    """What does not change by itself from one look to the next."""
    return view.model_copy(update={"seconds_left": None})
