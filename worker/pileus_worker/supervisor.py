"""A worker: claims tasks, has its render child do them, keeps the leases.

Leases are renewed here, never by the renderer: whatever happens in the child (a crash, a hang, its
memory) is a failed attempt, and the worker goes on with a new child.
"""

import contextlib
import logging
import math
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
from pydantic import ValidationError
from redis.exceptions import RedisError
from tenacity import (
    RetryError,
    Retrying,
    before_sleep_log,
    retry_if_exception_type,
    stop_when_event_set,
)
from tenacity.wait import wait_random_exponential

from pileus_service.jobs import Cause, Job, Kind, Task, WorkerInfo
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
FALSE_STARTS = 3  # in a row: then it is no accident that the child does not start
PATIENCE = 1.0
# After these a child is replaced, and they may be the fault of a cache that was read ahead.
UNSOUND = (Cause.CRASH, Cause.HANG, Cause.MEMORY)


@dataclass
class Limits:
    """What a child may use, how long the tasks that it plans are to be, and for how long it may
    get nowhere: reading a cache over a slow network takes its time, a hang takes for ever."""

    threads: int
    cache_bytes: int
    memory_bytes: int
    task_seconds: float
    stall_seconds: float


class Ending:
    """Whether and how soon a worker is to end: its task may finish within the grace, in seconds."""

    def __init__(self, grace: float) -> None:
        self._grace = grace
        self._at = math.inf
        self.asked = threading.Event()

    def ask(self, *, at_once: bool = False) -> None:
        """A second request is an impatient one."""
        impatient = at_once or self.asked.is_set()
        self._at = time.monotonic() + (0.0 if impatient else self._grace)
        self.asked.set()

    @property
    def overdue(self) -> bool:
        return time.monotonic() >= self._at


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
        # Until its first word it reads its program, which on a busy machine or a slow network takes
        # as long as any reading may.
        self._silence = setup.stall_seconds
        self._started = False

    def ready(self, seconds: float) -> bool:
        """Whether it can take an order; its first word is waited for, so long at most."""
        if self._started and not self._process.is_alive():
            raise ChildLostError(self._how_it_ended())
        return self._started or self.hear(seconds) is not None

    def order(self, order: child.Order) -> None:
        self._heard = time.monotonic()
        try:
            self._pipe.send(order)
        except OSError:
            raise ChildLostError(self._how_it_ended()) from None

    def permit(self) -> None:
        with contextlib.suppress(OSError):  # its end is heard of next
            self._pipe.send(child.Permit())

    def hear(self, seconds: float) -> child.Message | None:
        """What the child says within a time, or None."""
        try:
            if self._pipe.poll(seconds):
                message = child.MESSAGE.validate_json(self._pipe.recv_bytes(child.LONGEST_MESSAGE))
                self._heard, self._silence, self._started = time.monotonic(), SILENCE, True
                return message
        except ValidationError:
            raise ChildLostError("the render process said what none of ours does") from None
        except (EOFError, OSError):
            raise ChildLostError(self._how_it_ended()) from None
        if time.monotonic() - self._heard > self._silence:
            raise ChildLostError(
                f"the render process hung: silent for {self._silence:.0f} s", Cause.HANG
            )
        return None

    def cancel(self) -> bool:
        """Stops the task; False if the child did not stop in time and must be killed."""
        try:
            self._pipe.send(child.Cancel())
            end = time.monotonic() + PATIENCE
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
        self._process.join(PATIENCE)
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
            store.root,
            roots,
            limits.threads,
            limits.cache_bytes,
            limits.memory_bytes,
            limits.task_seconds,
            limits.stall_seconds,
            paths,
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
        self._false_starts = 0  # of children, in a row
        self._output = Output()
        # As Redis was when last spoken to: while it is away, nothing is told it that can be spared.
        self._away = False
        # Jobs whose next cache is not read ahead: a child was lost that did so.
        self._wary: set[str] = set()

    def run(self, ending: Ending) -> None:
        """Works until told to end; a task in hand is finished within the grace or handed back."""
        structlog.contextvars.bind_contextvars(worker=self.info.name)
        try:
            while not ending.asked.is_set():
                able, trouble = self._readiness()
                asked_at = time.monotonic()
                try:
                    task = self._queue.claim(self.info, self._farm(), able=able, trouble=trouble)
                    self._away = False
                except RedisError as error:
                    # Away, loading, or its disk is full: it comes back, and we are here then.
                    log.warning("no tasks to be had", reason=str(error))
                    task, self._away = None, True
                if task is not None:
                    self._attempt(task, asked_at, ending)
                elif able or trouble:
                    wait = PATIENCE if trouble else IDLE
                    ending.asked.wait(wait * random.uniform(0.5, 1.5))
            try:
                if not self._away:
                    self._queue.leave(self.info.name)
            except RedisError:
                log.info("Redis is gone before us; nothing to say goodbye to")
        finally:
            self._drop_child()

    def _farm(self) -> str | None:
        """The farm whose data folder ours is. Asked each time: a folder can come to be mounted."""
        try:
            return self._store.farm()
        except OSError:
            return None

    def _removed(self, job: str) -> bool:
        """Whether the farm has a job no more; it may only be out of our sight where its folder is
        not the farm's."""
        if not self._store.removed(job):
            return False
        farm = self._farm()  # after the look, as the folder may have gone before it
        return farm is not None and farm == self._queue.farm()

    def _readiness(self) -> tuple[bool, str]:
        """Whether the child can do a task at once, and if none will start, why. No task is claimed
        for one that still starts, which would hold it up for seconds, and its end in that time
        would count as the task's attempt."""
        try:
            if self._child is None:
                self._false_starts += 1
                self._child = Child(self._setup, self._output)
            if ready := self._child.ready(IDLE):
                self._false_starts = 0
            return ready, ""
        except (ChildLostError, OSError) as error:
            self._drop_child()
            output = self._output.take()
            log.warning("no render process", reason=str(error), output=output)
            if self._false_starts < FALSE_STARTS:
                return False, ""
            told = ": ".join([str(error), *output.splitlines()[-1:]])
            return False, f"its render process does not start: {told}"

    def _attempt(self, task: Task, leased: float, ending: Ending) -> None:
        """Does a task whose lease began at `leased`, and says how that went."""
        try:
            job = self._store.job(task.job)
            if job is None and self._removed(task.job):
                # Whoever removed it could not tell Redis, or has yet to.
                log.info("dropped: its job was removed", job=task.job, task=task.label)
                self._queue.control(task.job, "remove")
                return
            if job is None:
                raise FileNotFoundError(f"{self._store.root}: has no job {task.job}")
            frame = job.shot.frame_numbers[task.frame]
        except RedisError as error:
            log.warning("left for the next claim to hand back", reason=str(error))
            return
        except (OSError, IndexError) as error:
            log.warning("cannot begin", job=task.job, task=task.label, reason=str(error))
            self._tell(task, child.Failed(str(error), Cause.DISK), ending)
            return
        with structlog.contextvars.bound_contextvars(
            job=task.job, frame=frame, task=task.label, attempt=task.attempt
        ):
            outcome = self._try(job, frame, task, leased, ending)
            ahead = task.kind is Kind.RENDER and task.job not in self._wary
            if ahead and isinstance(outcome, child.Failed) and outcome.cause in UNSOUND:
                # It may have been the next frame's cache that the child died of.
                log.info("once more, without reading ahead")
                self._wary.add(task.job)
                outcome = self._try(job, frame, task, leased, ending)
            self._tell(task, outcome, ending)

    def _try(
        self, job: Job, frame: int, task: Task, leased: float, ending: Ending
    ) -> child.Finished | child.Failed | None:
        begun = time.monotonic()
        log.info("begun")
        outcome = self._do(job, frame, task, leased, ending)
        with contextlib.suppress(OSError, RedisError):
            if isinstance(outcome, child.Failed) and self._removed(job.id):
                outcome = None  # its files went under it
        self._note(task, outcome, time.monotonic() - begun)
        return outcome

    def _do(
        self, job: Job, frame: int, task: Task, leased: float, ending: Ending
    ) -> child.Finished | child.Failed | None:
        """Has the child do a task; whatever becomes of the child is the task's outcome."""
        try:
            if self._child is None:
                self._child = Child(self._setup, self._output)
            ahead = task.job not in self._wary
            self._child.order(child.Order(job, frame, task.kind, task.part, ahead))
            outcome = self._watch(self._child, task, leased, ending)
        except (ChildLostError, OSError) as error:
            self._drop_child()
            return child.Failed(str(error), getattr(error, "cause", Cause.DISK))
        if isinstance(outcome, child.Failed) and outcome.cause in UNSOUND:
            self._drop_child()
        return outcome

    def _note(
        self, task: Task, outcome: child.Finished | child.Failed | None, seconds: float
    ) -> None:
        """Tells the attempt's log and the farm's counters how it went."""
        try:
            if not self._away:
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
        self, task: Task, outcome: child.Finished | child.Failed | None, ending: Ending
    ) -> None:
        try:
            if isinstance(outcome, child.Finished):
                tell = self._queue.complete
                if not self._insist(ending)(tell, task, self.info.name, outcome.result):
                    log.warning("done, but another has the lease; the file counts")
            elif isinstance(outcome, child.Failed):
                self._insist(ending)(self._queue.fail, task, self.info.name, outcome.reason)
        except RetryError:
            self._away = True
            log.warning("Redis was not there to be told")

    def _watch(
        self, renderer: Child, task: Task, leased: float, ending: Ending
    ) -> child.Finished | child.Failed | None:
        """Sees a task through; None if it was given up because nobody wants it from us."""
        beat = child.Beat(-1, 0)  # its first word, once it has started, is a move
        moved = time.monotonic()
        renewal, look = time.monotonic(), time.monotonic() + LOOK
        ready = False
        while True:
            message = renderer.hear(0.1)
            self._output.drain()
            if isinstance(message, child.Finished | child.Failed):
                return message
            now = time.monotonic()
            if isinstance(message, child.Ready):
                ready, renewal, moved = True, now, now
            elif message is not None and message != beat:
                beat, moved = message, now
            try:
                if ending.overdue:
                    self._stop_child(renderer)
                    self._queue.hand_back(task, self.info.name)
                    return None
                if now >= renewal:
                    done = {"task": task, "samples": max(0, beat.samples)}
                    told = self.info.model_copy(update=done)
                    if (standing := self._queue.renew(task, told)) != "held":
                        log.warning("dropped", lease=standing)
                        self._give_up(renderer, task)
                        return None
                    leased, renewal = now, now + RENEWAL
                    if ready:
                        renderer.permit()
                        ready = False
                if now >= look:
                    look = now + LOOK
                    if self._queue.state(task.job) != "running":
                        self._give_up(renderer, task)
                        return None
                    self._away = False
            except RedisError as error:
                self._away = True
                log.warning("going on without Redis", reason=str(error))
                if ending.asked.is_set():
                    return None
            if time.monotonic() - leased > self._queue.lease:
                # Another has it by now, or will: nobody is to do one thing twice at a time. If it
                # is ours still when Redis is there again, the next claim hands it back.
                log.warning("dropped: no word from Redis for as long as a lease")
                self._stop_child(renderer)
                return None
            self._keep_within_limits(renderer, now - moved)

    def _keep_within_limits(self, renderer: Child, still: float) -> None:
        used = renderer.memory()
        if used > self._limits.memory_bytes:
            raise ChildLostError(
                f"the render process used {used >> 20} MiB of memory, over the "
                f"{self._limits.memory_bytes >> 20} MiB it may; give the worker more",
                Cause.MEMORY,
            )
        if still > self._limits.stall_seconds:
            raise ChildLostError(
                f"the render process got nowhere for {still:.0f} s; give a slow disk more with "
                "--stall-seconds",
                Cause.HANG,
            )

    def _give_up(self, renderer: Child, task: Task) -> None:
        self._stop_child(renderer)
        self._queue.hand_back(task, self.info.name)

    def _insist(self, ending: Ending) -> Retrying:
        """Tries until Redis is back: what was done must be said, unless we are to end."""
        return Retrying(
            retry=retry_if_exception_type(RedisError),
            wait=wait_random_exponential(max=2),
            stop=stop_when_event_set(ending.asked),
            before_sleep=before_sleep_log(logging.getLogger(__name__), logging.WARNING),
        )

    def _stop_child(self, renderer: Child) -> None:
        if not renderer.cancel():
            self._drop_child()

    def _drop_child(self) -> None:
        if self._child is not None:
            self._child.kill()
            self._child = None
