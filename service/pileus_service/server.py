"""Runs the service: uvicorn over the app, on a private or a shared Redis."""

import contextlib
import gc
import resource
import socket
from pathlib import Path

import uvicorn
from redis.exceptions import RedisError

from pileus_service import logs
from pileus_service.app import create_app
from pileus_service.auth import guard_for
from pileus_service.errors import InputError, data_troubles
from pileus_service.farm import Farm
from pileus_service.queue import Queue, connect
from pileus_service.roots import Roots
from pileus_service.store import Store


def split_address(listen: str) -> tuple[str, int]:
    host, colon, port = listen.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise InputError(f"--listen {listen}: write HOST:PORT, as 127.0.0.1:8765")
    return host.strip("[]"), int(port)


def bind(listen: str) -> socket.socket:
    """A bound socket; port 0 takes any that is free."""
    host, port = split_address(listen)
    try:
        listener = socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET
        )
        # Inherited by each connection. asyncio would set it, but not where a socket names no
        # protocol; without it an answer's body waits 40 ms for the client to acknowledge its head.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return listener
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"--listen {listen}: {reason}; choose another address") from None


def make_server(data: Path, redis_url: str, roots: list[Path], listen: str) -> uvicorn.Server:
    """A server ready to run."""
    host, _ = split_address(listen)
    with data_troubles(data):
        store = Store(data.resolve())
        guard = guard_for(host, data)
    # Each caller costs a file, whether or not it says anything: as many as the system gives.
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    farm = Farm(store, Queue(connect(redis_url)), Roots(roots, data))
    with contextlib.suppress(RedisError):  # it may come later
        farm.agreement.check()
    app = create_app(farm, guard)
    # Watchers hold their connections open: they are not waited for at the end.
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        log_level="warning",
        server_header=False,
        timeout_graceful_shutdown=1,
    )
    return uvicorn.Server(config)


def serve(data: Path, redis_url: str, roots: list[Path], listen: str) -> None:
    logs.configure()
    with contextlib.closing(bind(listen)) as listener:
        server = make_server(data, redis_url, roots, listen)
        # What is loaded by now stays: no full collection is to look through it while requests wait.
        gc.freeze()
        server.run([listener])
