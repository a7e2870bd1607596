"""Keeps Redis true to the disk: what is wanted of each job is told to Redis, and how it ended there
is noted on disk. The disk is the truth; what Redis lacks is built anew from it."""

import math
import threading
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator

import structlog

from pileus_service.errors import ForeignError
from pileus_service.jobs import TERMINAL, Wish
from pileus_service.queue import Mark, Queue, Standing, Verb
from pileus_service.store import Store
from pileus_service.webhooks import Webhooks

log = structlog.stdlib.get_logger(__name__)

COMPARE_ALL = 30.0
# So often what killed writers left is swept, when it has lain for as long: another service of this
# folder, or a worker, may just be writing.
SWEEP = 3600.0
# Thousands of jobs are compared by and by, so that a request never waits for more than a page.
PAGE = 200
BREATH = 0.005
_WISHED: dict[str, Verb] = {"paused": "pause", "running": "resume", "cancelled": "cancel"}


class Agreement:
    """What is wanted of the jobs, and made true. `lock` is held while a job is steered."""

    def __init__(self, store: Store, queue: Queue, hooks: Webhooks) -> None:
        self._store = store
        self._queue = queue
        self._hooks = hooks
        self.lock = threading.RLock()
        self._farm: str | None = None
        self._wished: dict[str, Standing] = {}
        self._seen: Mark | None = None
        self._compared = 0.0
        self._swept = -math.inf

    def check(self) -> None:
        """Sees that disk and Redis are of this farm and no other: two farms on one Redis, or a
        folder that is not mounted any more, would have us remove the jobs of all."""
        if self._farm is None:
            self._farm = self._store.begin()
        if self._store.farm() != self._farm:
            raise ForeignError(
                f"--data {self._store.root}: is not the folder that it was; mount that again, or "
                "start the service anew"
            )
        if not self._queue.serves(self._farm):
            raise ForeignError(
                f"--redis: serves the farm of another data folder than {self._store.root}; mount "
                "that one there, take another Redis, or empty this (FLUSHDB) if its farm is gone"
            )

    def reconcile(self) -> None:
        """Called each second: looks at the jobs that have changed since; at all of them at first,
        when Redis cannot tell, and as time passes."""
        self.check()
        mark, changed = self._queue.changed(self._seen)
        self._seen = None  # a look that is cut short is followed by one at all
        now = time.monotonic()
        if changed is None or now - self._compared >= COMPARE_ALL:
            self._compare_all()
            self._queue.forget_dead()
            self._compared = now
        else:
            for job_id, standing in self._standings(changed):
                if standing is not None and not self._store.has(job_id):
                    self._remove([job_id])
                elif standing is not None:
                    self._agree(job_id, standing)
        self._seen = mark
        if now - self._swept >= SWEEP:
            self._swept = now
            self._sweep()

    def keep(self, job_id: str, wish: Wish) -> None:
        """Writes what is wanted of a job, or how it ended, to the disk."""
        job = self._store.job(job_id) if wish.state in TERMINAL else None
        if job is not None:
            # First the notice: an end that is on disk is not looked at again.
            self._hooks.note_end(job, wish)
        self._store.wish(job_id, wish)
        self._wished[job_id] = _standing(wish)

    def forget(self, job_id: str) -> None:
        self._wished.pop(job_id, None)

    def states(self) -> Counter[str]:
        """How many jobs are in each state, as of the last look; those not begun are running."""
        return Counter(wish.state for wish in list(self._wished.values()))

    def restore(self, job_id: str) -> bool:
        """Puts a job of the disk into Redis; what it has finished stays finished."""
        job = self._store.job(job_id)
        if job is None:
            return False
        done = self._store.done_frames(job)
        wish = self._store.wished(job_id)
        frames = len(job.shot.frame_numbers)
        self._queue.submit(job_id, job.shot.name, job.created, frames, wish, done)
        return True

    def _compare_all(self) -> None:
        # Redis first: what is on no disk by now was removed, and not just submitted.
        in_redis = set(self._all_in_redis())
        on_disk = set(_slowly(self._store.job_ids(known=self._wished)))
        self._remove(in_redis - on_disk)
        for job_id in self._wished.keys() - on_disk:
            self.forget(job_id)
        astray = [
            (job_id, standing)
            for job_id, standing in self._standings(list(on_disk))
            if standing != self._wish(job_id)
        ]
        # Of many that Redis has lost, those with work to do come back first.
        for job_id, standing in sorted(
            astray, key=lambda each: (self._wish(each[0]).state in TERMINAL, each[0])
        ):
            self._agree(job_id, standing)

    def _remove(self, job_ids: Collection[str]) -> None:
        """Has Redis forget jobs that were not found on the disk, if that is the farm's still."""
        if job_ids:
            self.check()
        for job_id in job_ids:
            self._queue.control(job_id, "remove")

    def _sweep(self) -> None:
        before = time.time() - SWEEP
        self._store.sweep(before)
        for name in _slowly(self._store.folders()):
            self._store.sweep_job(name, before)

    def _all_in_redis(self) -> Iterator[str]:
        offset = 0
        while page := self._queue.job_ids(PAGE, offset):
            yield from page
            offset += PAGE
            time.sleep(BREATH)

    def _standings(self, job_ids: list[str]) -> Iterator[tuple[str, Standing | None]]:
        for at in range(0, len(job_ids), PAGE):
            page = job_ids[at : at + PAGE]
            yield from zip(page, self._queue.standings(page), strict=True)
            time.sleep(BREATH)

    def _wish(self, job_id: str) -> Standing:
        wish = self._wished.get(job_id)
        if wish is None:
            wish = self._wished[job_id] = _standing(self._store.wished(job_id))
        return wish

    def _agree(self, job_id: str, standing: Standing | None) -> None:
        if standing == self._wish(job_id):
            return
        with self.lock:
            # Another may have written since; what is on disk now holds.
            wish = self._wished[job_id] = _standing(self._store.wished(job_id))
            [now] = self._queue.standings([job_id])
            if now is None:
                self.restore(job_id)
            elif now.life != wish.life or (wish.state in TERMINAL and now.state != wish.state):
                # A Redis of an earlier day: this job is built anew, what it has finished stays.
                self._queue.control(job_id, "remove")
                self.restore(job_id)
            elif now.state in TERMINAL:
                if wish.state != now.state:
                    self._note_end(job_id, now.state)
            else:
                if wish.state != now.state:
                    self._queue.control(job_id, _WISHED[wish.state])
                if wish.priority != now.priority:
                    self._queue.control(job_id, "priority", wish.priority)

    def _note_end(self, job_id: str, state: str) -> None:
        view = self._queue.job(job_id)
        if view is not None:
            wish = Wish.model_validate(
                {
                    "state": state,
                    "priority": view.priority,
                    "life": self._wished[job_id].life,
                    "finished": view.finished,
                    "failed": self._queue.failed(job_id),
                }
            )
            self.keep(job_id, wish)
            log.info("ended", job=job_id, state=state, failed=len(wish.failed))


def _standing(wish: Wish) -> Standing:
    return Standing(wish.state, wish.priority, wish.life)


def _slowly(names: Iterable[str]) -> Iterator[str]:
    """The same, with a breath now and then for others."""
    for number, name in enumerate(names):
        if number % PAGE == PAGE - 1:
            time.sleep(BREATH)
        yield name
