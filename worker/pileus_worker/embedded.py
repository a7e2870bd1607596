"""The embedded farm: a private Redis, the service and N workers, begun and ended together."""

import contextlib
import fcntl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from pileus_service.errors import FarmError, InputError, data_troubles
from pileus_service.server import bind, make_server
from pileus_worker import machine
from pileus_worker.commands.worker import TASK_SECONDS
from pileus_worker.lifeline import die_with_parent
from pileus_worker.logfile import keep_bounded
from pileus_worker.private_redis import PrivateRedis


class Workers:
    """The worker processes; one that dies is replaced."""

    def __init__(self, command: list[str], count: int, log: IO[bytes]) -> None:
        self._command = command
        self._log = log
        self._processes = [self._start() for _ in range(count)]

    def keep_up(self) -> None:
        """Replaces those that have died, and keeps their log within its bound."""
        self._processes = [
            process if process.poll() is None else self._start() for process in self._processes
        ]
        keep_bounded(Path(self._log.name))

    def end(self) -> None:
        """Tells all to end, and sees to it."""
        for process in self._processes:
            process.terminate()
        end = time.monotonic() + 10
        for process in self._processes:
            try:
                process.wait(max(0.1, end - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            self._command,
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            # Away from the terminal's Ctrl-C: they are told in order.
            start_new_session=True,
            preexec_fn=die_with_parent,
        )


def _keep_up(
    ending: threading.Event, over: threading.Event, *parts: PrivateRedis | Workers
) -> None:
    """Starts again what dies, no faster than once a second."""
    while not ending.wait(1.0):
        for part in parts:
            part.keep_up()
    # To the kernel, the thread that started a process is its parent: we must outlive them.
    over.wait()


@dataclass(frozen=True)
class EmbeddedFarm:
    """A farm that runs."""

    url: str
    redis: PrivateRedis


@contextlib.contextmanager
def embedded_farm(
    data: Path, roots: list[Path], count: int, listen: str, task_seconds: float = TASK_SECONDS
) -> Iterator[EmbeddedFarm]:
    """Runs a farm while the block runs; whatever ends the block ends all of it, in order."""
    data = data.resolve()
    with contextlib.ExitStack() as held:
        with data_troubles(data):
            data.mkdir(parents=True, exist_ok=True)
            held.enter_context(_alone_in(data))
            log = held.enter_context((data / "workers.log").open("ab"))
            redis = held.enter_context(PrivateRedis(data / "redis"))
        listener = held.enter_context(contextlib.closing(bind(listen)))
        server = make_server(data, redis.farm_url, roots, listen)
        workers = Workers(_command(data, redis.farm_url, roots, count, task_seconds), count, log)
        ending, over = threading.Event(), threading.Event()
        service = threading.Thread(target=server.run, args=([listener],), name="service")
        keeper = threading.Thread(target=_keep_up, args=(ending, over, redis, workers), daemon=True)
        try:
            service.start()
            keeper.start()
            while not server.started:
                if not service.is_alive():
                    raise FarmError("the service ended at once")
                time.sleep(0.02)
            host, port = listener.getsockname()[:2]
            yield EmbeddedFarm(f"http://{_bracketed(host)}:{port}", redis)
        finally:
            ending.set()
            workers.end()
            server.should_exit = True
            service.join()
            redis.end()
            over.set()


def _command(
    data: Path, redis_url: str, roots: list[Path], count: int, task_seconds: float
) -> list[str]:
    threads = max(1, machine.cores() // count)
    memory = machine.memory_bytes() / count / (1 << 30)
    command = [sys.executable, "-m", "pileus_worker", "--data", str(data), "--redis", redis_url]
    command += [f"--threads={threads}", f"--memory={memory:.3f}", f"--task-seconds={task_seconds}"]
    command += ["--grace=0"]  # a person waits
    return [*command, *(f"--root={root}" for root in roots)]


@contextlib.contextmanager
def _alone_in(data: Path) -> Iterator[None]:
    """Two farms over one folder would fight over its Redis."""
    with (data / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"--data {data}: another farm runs there; stop it first") from None
        yield


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
