"""The render process: long-lived, takes orders through a pipe, dies alone.

It keeps the caches it has read from task to task. Its main thread answers the pipe four times a
second, so a parent can tell a long render from a hang.
"""

import os
import signal
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from pileus_service.jobs import Job, Kind, Result
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
class Finished:
    result: Result


@dataclass(frozen=True)
class Failed:
    reason: str


def run(pipe: "Connection[Any, Any]", setup: Setup) -> None:
    """The child's life, from its start to the end of its pipe."""
    # Heavy, and only of use in the child: the supervisor must survive what happens in here.
    from pileus_service.roots import Roots
    from pileus_service.store import Store
    from pileus_worker.caches import Caches
    from pileus_worker.lifeline import die_with_parent
    from pileus_worker.tasks import Work

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with_parent(signal.SIGKILL)
    store, roots = Store(setup.data), Roots(setup.roots)
    caches = Caches(setup.cache_bytes, setup.paths)
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
            future = executor.submit(work.run)
            while not wait([future], TICK).done:
                if pipe.poll():
                    pipe.recv()
                    work.control.cancel()
                pipe.send(Beat(work.control.samples_done))
            pipe.send(_outcome(future))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        os._exit(0)  # the parent is gone; nothing here is worth a tidy end


def _outcome(future: "Future[Result]") -> Finished | Failed:
    error = future.exception()
    if error is None:
        return Finished(future.result())
    if isinstance(error, ValueError | OSError | RuntimeError):
        return Failed(str(error))
    if isinstance(error, MemoryError):
        return Failed("out of memory")
    return Failed(f"{type(error).__name__}: {error}")
