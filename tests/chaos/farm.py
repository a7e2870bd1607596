"""A farm whose parts are processes of their own, so that each can be killed, stopped or drained."""

import contextlib
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Self

from pileus_service.client import Client
from pileus_service.errors import FarmError
from pileus_service.queue import Queue, connect
from pileus_service.store import Store
from pileus_worker.lifeline import die_with_parent
from pileus_worker.private_redis import PrivateRedis

PILEUS = str(Path(sys.executable).with_name("pileus"))


class Part:
    """A process that is started again whenever it ends, as systemd would."""

    def __init__(self, command: list[str], log: Path, env: dict[str, str] | None = None) -> None:
        self._command = command
        self._log = log
        self._env = {**os.environ, **(env or {})}
        self.process = self._start()

    def _start(self) -> "subprocess.Popen[bytes]":
        with self._log.open("ab") as log:
            return subprocess.Popen(
                self._command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=self._env,
                start_new_session=True,
                preexec_fn=die_with_parent,
            )

    @property
    def pid(self) -> int:
        return self.process.pid

    @property
    def children(self) -> list[int]:
        try:
            told = Path(f"/proc/{self.pid}/task/{self.pid}/children").read_text()
        except OSError:
            return []
        return [int(pid) for pid in told.split()]

    def keep_up(self) -> None:
        if self.process.poll() is not None:
            self.process = self._start()

    def end(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGCONT)
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Farm:
    """Redis, the service and workers over one folder; use as a context."""

    def __init__(
        self,
        folder: Path,
        roots: list[Path],
        workers: int,
        *,
        task_seconds: float = 0.02,
        options: tuple[str, ...] = (),
        env: dict[str, str] | None = None,
    ) -> None:
        self.folder = folder
        self.data = folder / "data"
        self.data.mkdir(parents=True, exist_ok=True)
        self.store = Store(self.data)
        self.redis = PrivateRedis(folder / "redis")
        self._roots = [f"--root={root}" for root in roots]
        self._count = workers
        self._options = [f"--task-seconds={task_seconds}", *options]
        self._env = env
        with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as free:
            self.listen = f"127.0.0.1:{free.getsockname()[1]}"
        self._over = threading.Event()
        # To the kernel, the thread that started a process is its parent: only it starts any.
        self._starter = threading.Thread(target=self._live, daemon=True)
        self._started = threading.Event()

    def __enter__(self) -> Self:
        self._starter.start()
        assert self._started.wait(60)
        self.queue = Queue(connect(self.redis.url))
        self.client = Client(f"http://{self.listen}")
        self.until_served()
        return self

    def __exit__(self, *_: object) -> None:
        self.client.__exit__(None, None, None)
        self.queue.redis.close()
        self._over.set()
        self._starter.join()

    def _live(self) -> None:
        with self.redis:
            common = ["--data", str(self.data), "--redis", self.redis.url, *self._roots]
            service = [PILEUS, "service", *common, "--listen", self.listen]
            worker = [sys.executable, "-m", "pileus_worker", *common, "--threads=1", *self._options]
            self.worker_command = worker
            self.service = Part(service, self.folder / "service.log")
            log = self.folder / "workers.log"
            self.workers = [Part(worker, log, self._env) for _ in range(self._count)]
            self._started.set()
            while not self._over.wait(0.2):
                self.redis.keep_up()
                for part in (self.service, *self.workers):
                    part.keep_up()
            for part in (*self.workers, self.service):
                part.end()

    def until_served(self, seconds: float = 120) -> float:
        """Waits until the service answers; returns for how long it did not."""
        begun = time.monotonic()
        while True:
            try:
                next(self.client.jobs(), None)
                return time.monotonic() - begun
            except FarmError:
                assert time.monotonic() - begun < seconds
                time.sleep(0.02)

    def until_workers(self, count: int) -> None:
        until(lambda: sum(worker.alive for worker in self.queue.workers()) >= count)

    def leftovers(self) -> list[str]:
        """What should not be there once all jobs have ended: in Redis, then on disk."""
        left = [f"{stream}: {depth}" for stream, depth in self.queue.depths().items() if any(depth)]
        for pattern in ("*:frame:*", "*:tries:*", "*:held", "*:ready", "*:active", "*:flight"):
            left += self.queue.redis.scan_iter(f"pileus:*{pattern}")
        # What the service or a worker was just writing for a job as a whole goes an hour later.
        self.store.sweep(math.inf)
        for job in self.store.folders():
            self.store.sweep_job(job, math.inf)
        for pattern in ("jobs/*/frames/*/parts", "**/.*", "**/*.tmp"):
            left += map(str, self.data.glob(pattern))
        return left


def until(what: Callable[[], bool], seconds: float = 60) -> None:
    """Waits for a condition."""
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it did not come to pass"
        time.sleep(0.02)


@contextlib.contextmanager
def frozen(*pids: int) -> Iterator[None]:
    """Stops processes while the block runs."""
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        for pid in pids:
            os.kill(pid, signal.SIGCONT)
