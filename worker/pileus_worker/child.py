"""The render process: long-lived, takes orders through a pipe, dies alone, by limits of its own.

It keeps the caches it has read from task to task. Its main thread answers the pipe ten times a
second, so a parent can tell a long render from a hang. All that it prints goes to its parent, which
keeps it with the attempt.
"""

import faulthandler
import os
import resource
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, TypeAdapter

from pileus_service.errors import printable
from pileus_service.jobs import Cause, Job, Kind, Result
from pileus_worker.paths import PathMap

if TYPE_CHECKING:
    from pileus_worker.tasks import Work

TICK = 0.1
NICE = 5
FILE_BYTES = 64 << 30
TASK_CPU_SECONDS = 6 * 3600  # of each thread


@dataclass(frozen=True)
class Setup:
    """What a child is started with."""

    data: Path
    roots: tuple[Path, ...]
    threads: int
    cache_bytes: int
    memory_bytes: int
    task_seconds: float
    stall_seconds: float
    paths: PathMap


@dataclass(frozen=True)
class Order:
    """A task to do, with its job, so that the child reads no queue."""

    job: Job
    frame: int
    kind: Kind
    part: int
    read_ahead: bool


@dataclass(frozen=True)
class Permit:
    """The task is still yours: put its frame in its place."""


@dataclass(frozen=True)
class Cancel:
    """Stop what you do; the outcome that follows is not waited for long."""


@dataclass(frozen=True)
class Beat:
    """The child lives, has done so many pixel samples of its task and taken so many other steps."""

    samples: int
    steps: int
    says: Literal["beat"] = "beat"


@dataclass(frozen=True)
class Spent:
    """What a task took: seconds of processor time and by phase, bytes of caches read."""

    cpu_seconds: float = 0.0
    cache_bytes: int = 0
    phases: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Ready:
    """A frame is whole, and waits for a Permit."""

    says: Literal["ready"] = "ready"


@dataclass(frozen=True)
class Finished:
    result: Result
    spent: Spent
    says: Literal["finished"] = "finished"


@dataclass(frozen=True)
class Failed:
    reason: str
    cause: Cause
    spent: Spent = Spent()
    says: Literal["failed"] = "failed"


# What the child says goes as JSON: it has read files that nobody vouches for, and must not be able
# to make its parent run anything.
Message = Annotated[Beat | Ready | Finished | Failed, Field(discriminator="says")]
MESSAGE: TypeAdapter[Message] = TypeAdapter(Message)
LONGEST_MESSAGE = 16 << 20


def run(pipe: "Connection[Any, Any]", output: "Connection[Any, Any]", setup: Setup) -> None:
    """The child's life, from its start to the end of its pipe."""
    for stream in (1, 2):
        os.dup2(output.fileno(), stream)
    faulthandler.enable()
    from pileus_worker.lifeline import die_with_parent

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    die_with_parent(signal.SIGKILL)
    # After the service, Redis and the supervisors of the same machine: they need little, and soon.
    os.nice(NICE)
    _limit(setup)
    try:
        Life(pipe, setup).live()
    except (EOFError, BrokenPipeError, ConnectionResetError):
        os._exit(0)  # the parent is gone; nothing here is worth a tidy end


def _outcome(work: "Work", spent: Callable[[], Spent]) -> Finished | Failed:
    # A RuntimeError is the core's word for what it could not write.
    causes = ((ValueError, Cause.INPUT), (OSError, Cause.DISK), (RuntimeError, Cause.DISK))
    try:
        return Finished(work.run(), spent())
    except MemoryError:
        return Failed("out of memory", Cause.MEMORY, spent())
    except Exception as error:
        for kind, cause in causes:
            if isinstance(error, kind):
                return Failed(printable(str(error)), cause, spent())
        return Failed(printable(f"{type(error).__name__}: {error}"), Cause.ERROR, spent())


def _limit(setup: Setup) -> None:
    """The parent looks at our memory now and then; this stops what grows faster than it looks.
    Stacks and code are not rendering's, so there is some room beyond. A file that grows without end
    fails as on a full disk."""
    most = setup.memory_bytes + (512 << 20) + setup.threads * (16 << 20)
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_BYTES, FILE_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _limit_task(setup.threads)


def _limit_task(threads: int) -> None:
    """Gives the task that begins its processor time: one that never ends dies, whatever it tells
    its parent. The limit is the process's, which has others behind it."""
    most = int(time.process_time()) + threads * TASK_CPU_SECONDS
    resource.setrlimit(resource.RLIMIT_CPU, (most, resource.RLIM_INFINITY))


class Life:
    """Does a task in a thread while the main thread talks with the parent."""

    def __init__(self, pipe: "Connection[Any, Any]", setup: Setup) -> None:
        # Heavy, and only of use in the child: the supervisor must survive what happens in here.
        from pileus_service.roots import Roots
        from pileus_service.store import Store
        from pileus_worker.caches import Caches
        from pileus_worker.tasks import Work

        self._pipe = pipe
        self._setup = setup
        self._store, self._roots = Store(setup.data), Roots(setup.roots, setup.data)
        self._caches = Caches(setup.cache_bytes, setup.paths, self._roots.reading)
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="task")
        self._new_work = Work
        self._work: Work | None = None
        self._saying = threading.RLock()
        self._permitted = threading.Event()
        self._denied = False
        self._told_bytes = 0

    def live(self) -> None:
        self._say(Beat(0, 0))
        while True:
            if not self._pipe.poll(TICK):
                self._beat()
                continue
            message, work = self._pipe.recv(), self._work
            if isinstance(message, Order):
                self._permitted.clear()
                self._denied = False
                _limit_task(self._setup.threads)
                self._work = self._begin(message)
                self._executor.submit(self._do, self._work)
            elif isinstance(message, Permit):
                self._permitted.set()
            elif work is not None:
                work.control.cancel()
                self._denied = True
                self._permitted.set()

    def _begin(self, order: Order) -> "Work":
        return self._new_work(
            self._store,
            self._roots,
            self._caches,
            self._setup.threads,
            self._setup.task_seconds,
            order.job,
            order.frame,
            order.kind,
            order.part,
            self._setup.paths,
            self._await_permit,
            order.read_ahead,
        )

    def _do(self, work: "Work") -> None:
        cpu = time.process_time()

        def spent() -> Spent:
            # What was read ahead between two tasks counts for the later one.
            told, self._told_bytes = self._told_bytes, self._caches.bytes_read
            return Spent(time.process_time() - cpu, self._told_bytes - told, work.phases)

        outcome = _outcome(work, spent)
        with self._saying:
            self._work = None
            self._say(outcome)

    def _beat(self) -> None:
        """Never after the outcome: the parent would take it for the next task's."""
        with self._saying:
            if self._work is not None:
                self._say(Beat(self._work.control.samples_done, self._work.steps))

    def _await_permit(self) -> None:
        """Waits until the parent knows that the lease is ours; if it is not, the task is over."""
        self._say(Ready())
        self._permitted.wait()
        if self._denied:
            raise RuntimeError("the task is another's by now")

    def _say(self, message: Message) -> None:
        with self._saying:
            self._pipe.send_bytes(MESSAGE.dump_json(message))
