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

import structlog
from redis.exceptions import RedisError
from tenacity import (
    RetryError,
    Retrying,
    before_sleep_log,
    retry_if_exception_type,
    stop_when_event_set,
)
from tenacity.wait import wait_random_exponential

from pileus_service.jobs import Cause, Job, Task, WorkerInfo
from pileus_service.measures import Measures
from pileus_service.queue import RENEWAL, Queue
from pileus_service.store import Store
from pileus_worker import child
from pileus_worker.accounts import account
from pileus_worker.output import Output
from pileus_worker.paths import PathMap

log = structlog.stdlib.get_logger(__name__)

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

    def __init__(self, reason: str, cause: Cause = Cause.CRASH) -> None:
        super().__init__(reason)
        self.cause = cause


class Child:
    """The render process as seen from outside."""

    def __init__(self, setup: child.Setup, output: Output) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe: Connection[Any, Any]
        self._pipe, theirs = context.Pipe()
        arguments = (theirs, output.writing, setup)
        self._process = context.Process(target=child.run, args=arguments, daemon=True)
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
            raise ChildLostError(f"the render process hung: silent for {SILENCE:.0f} s", Cause.HANG)
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
        self._measures = Measures(queue.redis)
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
        self._output = Output()

    def run(self, stop: threading.Event) -> None:
        """Works until told to stop; a task in hand is handed back."""
        structlog.contextvars.bind_contextvars(worker=self.info.name)
        try:
            while not stop.is_set():
                try:
                    task = self._queue.claim(self.info)
                except RedisError as error:
                    # Away, loading, or its disk is full: it comes back, and we are here then.
                    log.warning("no tasks to be had", reason=str(error))
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
        try:
            job = self._store.job(task.job)
            if job is None:
                raise FileNotFoundError(f"{self._store.root}: has no job {task.job}")
        except OSError as error:
            log.warning("cannot begin", job=task.job, task=task.label, reason=str(error))
            self._tell(task, child.Failed(str(error), Cause.DISK), stop)
            return
        frame = job.shot.frame_numbers[task.frame]
        with structlog.contextvars.bound_contextvars(
            job=task.job, frame=frame, task=task.label, attempt=task.attempt
        ):
            begun = time.monotonic()
            log.info("begun")
            outcome = self._do(job, frame, task, stop)
            self._note(task, outcome, time.monotonic() - begun)
            self._tell(task, outcome, stop)

    def _do(
        self, job: Job, frame: int, task: Task, stop: threading.Event
    ) -> child.Finished | child.Failed | None:
        """Has the child do a task; whatever becomes of the child is the task's outcome."""
        try:
            if self._child is None:
                self._child = Child(self._setup, self._output)
            self._child.order(child.Order(job, frame, task.kind, task.part))
            return self._watch(self._child, task, stop)
        except (ChildLostError, OSError) as error:
            self._drop_child()
            return child.Failed(str(error), getattr(error, "cause", Cause.DISK))

    def _note(
        self, task: Task, outcome: child.Finished | child.Failed | None, seconds: float
    ) -> None:
        """Tells the attempt's log and the farm's counters how it went."""
        try:
            self._measures.add(account(task.kind, outcome, seconds, self._limits.threads))
        except RedisError as error:
            log.info("not counted", reason=str(error))
        told: dict[str, Any] = {"seconds": round(seconds, 3)}
        if output := self._output.take():
            told["output"] = output
        if isinstance(outcome, child.Failed):
            log.warning("failed", cause=str(outcome.cause), reason=outcome.reason, **told)
        else:
            log.info("done" if outcome else "given up", **told)

    def _tell(
        self, task: Task, outcome: child.Finished | child.Failed | None, stop: threading.Event
    ) -> None:
        try:
            if isinstance(outcome, child.Finished):
                tell = self._queue.complete
                if not self._insist(stop)(tell, task, self.info.name, outcome.result):
                    log.warning("done, but another has the lease; the file counts")
            elif isinstance(outcome, child.Failed):
                self._insist(stop)(self._queue.fail, task, self.info.name, outcome.reason)
        except RetryError:
            log.warning("Redis was not there to be told")

    def _watch(
        self, renderer: Child, task: Task, stop: threading.Event
    ) -> child.Finished | child.Failed | None:
        """Sees a task through; None if it was given up because nobody wants it from us."""
        samples = 0
        renewal, look = time.monotonic(), time.monotonic() + LOOK
        while True:
            message = renderer.hear(0.1)
            self._output.drain()
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
                        log.warning("another has the lease; dropped")
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
                log.warning("going on without Redis", reason=str(error))
                if stop.is_set():
                    return None
            used = renderer.memory()
            if used > self._limits.memory_bytes:
                raise ChildLostError(
                    f"the render process used {used >> 20} MiB of memory, over the "
                    f"{self._limits.memory_bytes >> 20} MiB it may; give the worker more",
                    Cause.MEMORY,
                )

    def _insist(self, stop: threading.Event) -> Retrying:
        """Tries until Redis is back: what was done must be said, unless we are to end."""
        return Retrying(
            retry=retry_if_exception_type(RedisError),
            wait=wait_random_exponential(max=2),
            stop=stop_when_event_set(stop),
            before_sleep=before_sleep_log(logging.getLogger(__name__), logging.WARNING),
        )

    def _stop_child(self, renderer: Child) -> None:
        if not renderer.cancel():
            self._drop_child()

    def _drop_child(self) -> None:
        if self._child is not None:
            self._child.kill()
            self._child = None
