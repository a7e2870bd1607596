"""`pileus service`: the HTTP service alone."""

from pathlib import Path

import typer

from pileus_service.options import DATA, LISTEN, REDIS, Data, Listen, Redis, RootFolders
from pileus_service.server import serve

app = typer.Typer()


@app.command("service")
def service(
    data: Data = DATA,
    redis: Redis = REDIS,
    root: RootFolders = None,
    listen: Listen = LISTEN,
) -> None:
    """Runs the HTTP service alone; workers join it through Redis and the data folder."""
    serve(data, redis, root or [Path.cwd()], listen)
