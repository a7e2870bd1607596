"""A Redis of our own: a child process on a Unix socket, its append-only file in a folder.

Its settings are those of a farm of many machines (redis.conf), the farm's narrow user included.
"""

import shutil
import subprocess
import tempfile
from importlib.resources import files
from pathlib import Path
from types import TracebackType
from typing import Self

from redis import Redis
from tenacity import retry, retry_if_exception_type, stop_after_delay, wait_fixed

from pileus_service.errors import FarmError
from pileus_service.queue import UNREACHABLE
from pileus_worker.lifeline import die_with_parent
from pileus_worker.logfile import keep_bounded

LOG = "redis.log"
NO_PASSWORD_FITS = "#" + 64 * "0"


class PrivateRedis:
    """Starts on entry, answers before entry ends, is stopped in order on exit. `url` may do all,
    `farm_url` what the farm does."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        # Not in the folder itself: a socket's path may have 107 characters at most.
        self._socket_folder = Path(tempfile.mkdtemp(prefix="pileus-"))
        self._socket = self._socket_folder / "redis"
        self._settings = self._socket_folder / "redis.conf"
        # The socket lies in a folder of ours alone, which is password enough.
        shared = (files("pileus_worker") / "redis.conf").read_text()
        self._settings.write_text(shared.replace(NO_PASSWORD_FITS, "nopass"))
        self.url = f"unix://{self._socket}"
        self.farm_url = f"unix://pileus@{self._socket}"
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def __enter__(self) -> Self:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._start()
        self._answers()
        return self

    def keep_up(self) -> None:
        """Starts it again if it has died; it reads its file, and what that lacks is on disk."""
        keep_bounded(self._folder / LOG)
        if self._process is not None and self._process.poll() is not None:
            self._start()

    def _start(self) -> None:
        program = shutil.which("redis-server")
        if program is None:
            raise FarmError(
                "redis-server is not installed; on Debian: apt-get install redis-server"
            )
        options = {
            "port": "0",
            "unixsocket": str(self._socket),
            "unixsocketperm": "700",
            "dir": str(self._folder.resolve()),
            "logfile": LOG,
        }
        words = [word for key, value in options.items() for word in (f"--{key}", value)]
        self._process = subprocess.Popen(
            [program, self._settings, *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            # Away from the terminal's Ctrl-C: Redis is the last to go.
            start_new_session=True,
            preexec_fn=die_with_parent,
        )

    @retry(
        retry=retry_if_exception_type(UNREACHABLE),
        stop=stop_after_delay(20),
        wait=wait_fixed(0.02),
        reraise=True,
    )
    def _answers(self) -> None:
        if self._process is not None and self._process.poll() is not None:
            raise FarmError(f"redis-server ended at once; see {self._folder / LOG}")
        with Redis.from_url(self.url) as client:
            client.ping()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.end()
        shutil.rmtree(self._socket_folder, ignore_errors=True)

    def end(self) -> None:
        """Stops it, its file written."""
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(10)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
