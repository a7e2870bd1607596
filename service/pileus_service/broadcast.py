"""One look at the farm for all who listen: jobs that are watched are read together, twice a second,
and each change is put into bytes once, so that listeners cost a write each and Redis nothing."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

from redis.exceptions import RedisError
from sse_starlette import ServerSentEvent
from starlette.concurrency import run_in_threadpool

from pileus_service.farm import Farm
from pileus_service.jobs import TERMINAL, JobView

EVERY = 0.5
# Listeners are woken a few at a time, so that requests are answered in between.
AT_ONCE = 8
BREATH = 0.003


@dataclass
class _Watched:
    """A job that somebody listens to: what was said of it last, and who waits for more."""

    listeners: int = 0
    said: JobView | None = None
    event: bytes = b""
    number: int = 0  # of things said
    spread: int = 0  # how many of them those who wait have been woken for
    waiting: set["asyncio.Future[None]"] = field(default_factory=set)

    def say(self, view: JobView | None) -> None:
        """Takes in what the job is now; None, that it is gone."""
        if self.number and _steady(view) == _steady(self.said):
            return
        self.said = view
        self.number += 1
        if view is not None:
            self.event = ServerSentEvent(view.model_dump_json(), event="job").encode()

    async def next(self) -> None:
        news = asyncio.get_running_loop().create_future()
        self.waiting.add(news)
        try:
            await news
        finally:
            self.waiting.discard(news)

    async def wake(self) -> None:
        """Those who wait; they may wait anew before the last of them is woken."""
        if self.spread == self.number:
            return
        self.spread = self.number
        for count, news in enumerate(list(self.waiting), 1):
            if not news.done():
                news.set_result(None)
            if count % AT_ONCE == 0:
                await asyncio.sleep(BREATH)


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
            if watched is not None:
                watched.say(view)
                await watched.wake()

    async def events(self, job: JobView) -> AsyncIterator[bytes]:
        """Server-sent: the job now, then each time it changes, until it ends or is removed."""
        watched = self._watched.setdefault(job.id, _Watched())
        watched.listeners += 1
        try:
            watched.say(job)  # it was read just now
            told = 0
            while watched.said is not None:
                if told != watched.number:
                    told, last = watched.number, watched.said.state in TERMINAL
                    yield watched.event
                    if last:
                        return
                else:
                    await watched.next()
        finally:
            watched.listeners -= 1
            if watched.listeners == 0 and self._watched.get(job.id) is watched:
                del self._watched[job.id]


def _steady(view: JobView | None) -> JobView | None:
    """What does not change by itself from one look to the next."""
    return view and view.model_copy(update={"seconds_left": None})
