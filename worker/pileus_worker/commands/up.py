"""`pileus up`: the embedded farm, until Ctrl-C."""

import signal
import sys
import threading
from pathlib import Path
from typing import Annotated

import typer

from pileus_service import logs
from pileus_service.options import DATA, LISTEN, Data, Listen, RootFolders
from pileus_worker.embedded import embedded_farm

app = typer.Typer()


@app.command("up")
def up(
    workers: Annotated[int, typer.Option(min=1, max=256, help="How many worker processes.")] = 1,
    data: Data = DATA,
    root: RootFolders = None,
    listen: Listen = LISTEN,
) -> None:
    """Runs a whole farm on this machine: Redis, service and workers. Ctrl-C ends all of it."""
    logs.configure()
    stop = threading.Event()
    # Before anything starts, so that no signal finds half a farm.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with embedded_farm(data, root or [Path.cwd()], workers, listen) as farm:
        print(f"The farm is up: {farm.url} (a page, and the API), {workers} worker(s)", flush=True)
        stop.wait()
        print("Ending...", file=sys.stderr)
