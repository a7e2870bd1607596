"""The render process: long-lived, takes orders through a pipe, dies alone.

It keeps the caches it has read from task to task. Its main thread answers the pipe four times a
second, so a parent can tell a long render from a hang. All that it prints goes to its parent, which
keeps it with the attempt.
"""

import faulthandler
import os
import signal
import time
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from pileus_service.jobs import Cause, Job, Kind, Result
from pileus_worker.paths import PathMap

TICK = 0.1


@dataclass(frozen=True)
class Setup:
    """What a child is started with."""

    data: Path
    roots: tuple[Path, ...]
    threads: int
    cache_bytes: int
    task_seconds: float
    paths: PathMap


@dataclass(frozen=True)
class Order:
    """A task to do, with its job, so that the child reads no queue."""

    job: Job
    frame: int
    kind: Kind
    part: int


@dataclass(frozen=True)
class Cancel:
    """Stop what you do; the outcome that follows is not waited for long."""


@dataclass(frozen=True)
class Beat:
    """The child lives, and has done so many pixel samples of its task."""

    samples: int


@dataclass(frozen=True)
class Spent:
    """What a task took: seconds of processor time and by phase, bytes of caches read."""

    cpu_seconds: float = 0.0
    cache_bytes: int = 0
    phases: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Finished:
    result: Result
    spent: Spent


@dataclass(frozen=True)
class Failed:
    reason: str
    cause: Cause
    spent: Spent = Spent()


def run(pipe: "Connection[Any, Any]", output: "Connection[Any, Any]", setup: Setup) -> None:
    """The child's life, from its start to the end of its pipe."""
    for stream in (1, 2):
        os.dup2(output.fileno(), stream)
    faulthandler.enable()
    # Heavy, and only of use in the child: the supervisor must survive what happens in here.
    from pileus_service.roots import Roots
    from pileus_service.store import Store
    from pileus_worker.caches import Caches
    from pileus_worker.lifeline import die_with_parent
    from pileus_worker.tasks import Work

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with_parent(signal.SIGKILL)
    store, roots = Store(setup.data), Roots(setup.roots, setup.data)
    caches = Caches(setup.cache_bytes, setup.paths, roots.reading)
    executor = ThreadPoolExecutor(1, thread_name_prefix="task")
    try:
        while True:
            order = pipe.recv()
            if isinstance(order, Cancel):
                continue  # came too late for the task that it meant
            work = Work(
                store,
                roots,
                caches,
                setup.threads,
                setup.task_seconds,
                order.job,
                order.frame,
                order.kind,
                order.part,
                setup.paths,
            )
            cpu, read = time.process_time(), caches.bytes_read
            future = executor.submit(work.run)
            while not wait([future], TICK).done:
                if pipe.poll():
                    pipe.recv()
                    work.control.cancel()
                pipe.send(Beat(work.control.samples_done))
            spent = Spent(time.process_time() - cpu, caches.bytes_read - read, work.phases)
            pipe.send(_outcome(future, spent))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        os._exit(0)  # the parent is gone; nothing here is worth a tidy end


def _outcome(future: "Future[Result]", spent: Spent) -> Finished | Failed:
    error = future.exception()
    if error is None:
        return Finished(future.result(), spent)
    if isinstance(error, MemoryError):
        return Failed("out of memory", Cause.MEMORY, spent)
    # A RuntimeError is the core's word for what it could not write.
    causes = ((ValueError, Cause.INPUT), (OSError, Cause.DISK), (RuntimeError, Cause.DISK))
    for kind, cause in causes:
        if isinstance(error, kind):
            return Failed(str(error), cause, spent)
    return Failed(f"{type(error).__name__}: {error}", Cause.ERROR, spent)
