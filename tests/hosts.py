"""Service and workers as processes of their own, as on many machines: what `pileus up` joins."""

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pileus_core as core

from pileus_service.client import Client
from pileus_service.shot import Shot

PILEUS = Path(sys.executable).with_name("pileus")


@contextlib.contextmanager
def process(
    log: Path, *command: str | Path, env: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """A process that ends with the block, its words in a file."""
    with log.open("ab") as words:
        started = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=words,
            stderr=words,
            env={**os.environ, **(env or {})},
        )
        try:
            yield started
        finally:
            started.terminate()
            try:
                started.wait(20)
            except subprocess.TimeoutExpired:
                started.kill()
                started.wait()


@contextlib.contextmanager
def service(data: Path, redis: str, *roots: Path) -> Iterator[Client]:
    """`pileus service` and a client of it."""
    port = free_port()
    words = [f"--root={root}" for root in roots]
    listen = f"127.0.0.1:{port}"
    log = data.parent / "service.log"
    command: list[str | Path] = [PILEUS, "service", "--data", data, "--redis", redis]
    command += ["--listen", listen, *words]
    with process(log, *command) as serving, Client(f"http://{listen}") as client:

        def answers() -> bool:
            assert serving.poll() is None, log.read_text()
            return _connects(port)

        until(answers, 120)
        yield client


def until(holds: Callable[[], object], seconds: float) -> None:
    """Waits for something to be so."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


def same_images(shot: Shot, folder: Path) -> None:
    """The farm's images are those that `pileus render` makes here."""
    file = folder / "shot.json"
    file.write_text(shot.model_dump_json())
    subprocess.run([PILEUS, "render", file, "--out", folder / "here"], check=True)
    for frame in shot.frame_numbers:
        [farm] = core.read_image(str(shot.output(frame))).values()
        [here] = core.read_image(str(folder / "here" / shot.output(frame).name)).values()
        for name, values in here.items():
            np.testing.assert_allclose(farm[name], values, rtol=1e-6, atol=1e-6, err_msg=name)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def _connects(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
        return True
    return False
