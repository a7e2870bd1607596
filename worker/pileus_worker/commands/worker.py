"""`pileus worker`: one worker, until it is told to stop."""

import signal
from pathlib import Path
from typing import Annotated

import typer

from pileus_service import logs
from pileus_service.errors import data_troubles
from pileus_service.framelog import FrameLog
from pileus_service.options import DATA, REDIS, Data, Redis, RootFolders
from pileus_service.queue import Queue, connect
from pileus_service.roots import Roots
from pileus_service.store import Store
from pileus_worker import machine
from pileus_worker.paths import PathMap
from pileus_worker.supervisor import Ending, Limits, Supervisor

app = typer.Typer()

# Long enough to hide what a task costs besides, short enough to lose little with a worker.
TASK_SECONDS = 4.0
# Shorter than what Docker, Slurm and Kubernetes wait between SIGTERM and SIGKILL.
GRACE = 8.0
STALL_SECONDS = 300.0


@app.command("worker")
def worker(
    data: Data = DATA,
    redis: Redis = REDIS,
    root: RootFolders = None,
    maps: Annotated[
        list[str] | None,
        typer.Option(
            "--map",
            metavar="FROM=TO",
            help="The shots' folder FROM is TO on this machine; repeatable.",
        ),
    ] = None,
    threads: Annotated[int, typer.Option(min=0, max=1024, help="0 takes all cores.")] = 0,
    memory: Annotated[
        float, typer.Option(min=0, help="GiB that rendering may take; 0: most of the machine.")
    ] = 0.0,
    task_seconds: Annotated[
        float, typer.Option(min=0.001, max=600, help="How long a task is planned to take.")
    ] = TASK_SECONDS,
    grace: Annotated[
        float, typer.Option(min=0, help="Seconds that a task may take to finish after SIGTERM.")
    ] = GRACE,
    stall_seconds: Annotated[
        float, typer.Option(min=1, help="How long a task may get nowhere, as when it reads.")
    ] = STALL_SECONDS,
) -> None:
    """Runs one worker: takes tasks from Redis until it gets SIGTERM or Ctrl-C.

    After SIGTERM it finishes its task within the grace or hands it back; a second one, or Ctrl-C,
    makes it hand the task back at once.
    """
    with data_troubles(data):
        store = Store(data.resolve())
    logs.configure(FrameLog(store))
    ending = Ending(grace)
    signal.signal(signal.SIGTERM, lambda *_: ending.ask())
    signal.signal(signal.SIGINT, lambda *_: ending.ask(at_once=True))
    allowed = int(memory * (1 << 30)) or machine.memory_bytes()
    limits = Limits(
        threads or machine.cores(),
        machine.cache_bytes(allowed),
        allowed,
        task_seconds,
        stall_seconds,
    )
    queue = Queue(connect(redis))
    roots = Roots(root or [Path.cwd()])
    paths = PathMap.parse(maps or [])
    Supervisor(queue, store, tuple(roots.folders), limits, paths).run(ending)
