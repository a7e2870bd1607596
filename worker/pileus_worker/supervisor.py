"""A worker: claims tasks, has its render child do them, keeps the leases.

Leases are renewed here, never by the renderer: whatever happens in the child (a crash, a hang, its
memory) is a failed attempt, and the worker goes on with a new child.
"""

import logging
import multiprocessing
import os
import random
import secrets
import socket
import threading
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from redis.exceptions import RedisError
from tenacity import (
    RetryError,
    Retrying,
    before_sleep_log,
    retry_if_exception_type,
    stop_when_event_set,
)
from tenacity.wait import wait_random_exponential

from pileus_service.jobs import Task, WorkerInfo
from pileus_service.queue import RENEWAL, Queue
from pileus_service.store import Store
from pileus_worker import child
from pileus_worker.paths import PathMap

log = logging.getLogger(__name__)

IDLE = 0.2
LOOK = 0.5
SILENCE = 30.0
GRACE = 1.0


@dataclass
class Limits:
    """What a child may use, and how long the tasks that it plans are to be."""

    threads: int
    cache_bytes: int
    memory_bytes: int
    task_seconds: float


class ChildLostError(Exception):
    """The child has ended, or has to; the message says how."""


class Child:
    """The render process as seen from outside."""

    def __init__(self, setup: child.Setup) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe: Connection[Any, Any]
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=child.run, args=(theirs, setup), daemon=True)
        self._process.start()
        theirs.close()
        self._heard = time.monotonic()

    def order(self, order: child.Order) -> None:
        self._heard = time.monotonic()
        try:
            self._pipe.send(order)
        except OSError:
            raise ChildLostError(self._how_it_ended()) from None

    def hear(self, seconds: float) -> child.Beat | child.Finished | child.Failed | None:
        """What the child says within a time, or None."""
        try:
            if self._pipe.poll(seconds):
                message: child.Beat | child.Finished | child.Failed = self._pipe.recv()
                self._heard = time.monotonic()
                return message
        except (EOFError, OSError):
            raise ChildLostError(self._how_it_ended()) from None
        if time.monotonic() - self._heard > SILENCE:
            raise ChildLostError(f"the render process hung: silent for {SILENCE:.0f} s")
        return None

    def cancel(self) -> bool:
        """Stops the task; False if the child did not stop in time and must be killed."""
        try:
            self._pipe.send(child.Cancel())
            end = time.monotonic() + GRACE
            while time.monotonic() < end:
                if isinstance(self.hear(0.05), child.Finished | child.Failed):
                    return True
        except (OSError, ChildLostError):
            pass
        return False

    def memory(self) -> int:
        """Resident bytes."""
        try:
            pages = int(Path(f"/proc/{self._process.pid}/statm").read_text().split()[1])
        except (OSError, IndexError):
            return 0
        return pages * os.sysconf("SC_PAGE_SIZE")

    def kill(self) -> None:
        self._process.kill()
        self._process.join()
        self._pipe.close()

    def _how_it_ended(self) -> str:
        self._process.join(GRACE)
        code = self._process.exitcode
        if code is not None and code < 0:
            return f"the render process died of signal {-code}"
        return f"the render process ended with code {code}"


class Supervisor:
    """One worker's life."""

    def __init__(
        self,
        queue: Queue,
        store: Store,
        roots: tuple[Path, ...],
        limits: Limits,
        paths: PathMap,
    ) -> None:
        self._queue = queue
        self._store = store
        self._limits = limits
        self._setup = child.Setup(
            store.root, roots, limits.threads, limits.cache_bytes, limits.task_seconds, paths
        )
        host = socket.gethostname()
        self.info = WorkerInfo(
            name=f"{host}-{os.getpid()}-{secrets.token_hex(2)}",
            host=host,
            pid=os.getpid(),
            threads=limits.threads,
            started=time.time(),
        )
        self._child: Child | None = None

    def run(self, stop: threading.Event) -> None:
        """Works until told to stop; a task in hand is handed back."""
        try:
            while not stop.is_set():
                try:
                    task = self._queue.claim(self.info)
                except RedisError as error:
                    # Away, loading, or its disk is full: it comes back, and we are here then.
                    log.warning("no tasks to be had: %s", error)
                    task = None
                if task is None:
                    stop.wait(IDLE * random.uniform(0.5, 1.5))
                else:
                    self._attempt(task, stop)
            try:
                self._queue.leave(self.info.name)
            except RedisError:
                log.info("Redis is gone before us; nothing to say goodbye to")
        finally:
            self._drop_child()

    def _attempt(self, task: Task, stop: threading.Event) -> None:
        log.info("%s, attempt %d", task, task.attempt)
        try:
            job = self._store.job(task.job)
            if job is None:
                raise ChildLostError(f"{self._store.root}: has no job {task.job}")
            if self._child is None:
                self._child = Child(self._setup)
            self._child.order(
                child.Order(job, job.shot.frame_numbers[task.frame], task.kind, task.part)
            )
            outcome = self._watch(self._child, task, stop)
        except (ChildLostError, OSError) as error:
            self._drop_child()
            outcome = child.Failed(str(error))
        try:
            if isinstance(outcome, child.Finished):
                tell = self._queue.complete
                if not self._insist(stop)(tell, task, self.info.name, outcome.result):
                    log.warning("%s: done, but another has the lease; the file counts", task)
            elif isinstance(outcome, child.Failed):
                log.warning("%s: %s", task, outcome.reason)
                self._insist(stop)(self._queue.fail, task, self.info.name, outcome.reason)
        except RetryError:
            log.warning("%s: Redis was not there to be told", task)

    def _watch(
        self, renderer: Child, task: Task, stop: threading.Event
    ) -> child.Finished | child.Failed | None:
        """Sees a task through; None if it was given up because nobody wants it from us."""
        samples = 0
        renewal, look = time.monotonic(), time.monotonic() + LOOK
        while True:
            message = renderer.hear(0.1)
            if isinstance(message, child.Finished | child.Failed):
                return message
            if message is not None:
                samples = message.samples
            now = time.monotonic()
            try:
                if stop.is_set():
                    self._stop_child(renderer)
                    self._queue.hand_back(task, self.info.name)
                    return None
                if now >= renewal:
                    renewal = now + RENEWAL
                    told = self.info.model_copy(update={"task": task, "samples": samples})
                    if not self._queue.renew(task, told):
                        log.warning("%s: another has the lease; dropped", task)
                        self._stop_child(renderer)
                        return None
                if now >= look:
                    look = now + LOOK
                    if self._queue.state(task.job) not in ("running", "paused"):
                        self._stop_child(renderer)
                        self._queue.hand_back(task, self.info.name)
                        return None
            except RedisError as error:
                # The work stays good: the lease is renewed, or found lost, when Redis is back.
                log.warning("going on with %s: %s", task, error)
                if stop.is_set():
                    return None
            used = renderer.memory()
            if used > self._limits.memory_bytes:
                raise ChildLostError(
                    f"the render process used {used >> 20} MiB of memory, over the "
                    f"{self._limits.memory_bytes >> 20} MiB it may; give the worker more"
                )

    def _insist(self, stop: threading.Event) -> Retrying:
        """Tries until Redis is back: what was done must be said, unless we are to end."""
        return Retrying(
            retry=retry_if_exception_type(RedisError),
            wait=wait_random_exponential(max=2),
            stop=stop_when_event_set(stop),
            before_sleep=before_sleep_log(log, logging.WARNING),
        )

    def _stop_child(self, renderer: Child) -> None:
        if not renderer.cancel():
            self._drop_child()

    def _drop_child(self) -> None:
        if self._child is not None:
            self._child.kill()
            self._child = None
