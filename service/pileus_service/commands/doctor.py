"""`pileus doctor`: looks at a host and at what it is told of the farm."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from pileus_service import doctor, terminal
from pileus_service.errors import FarmError
from pileus_service.options import AsJson, Token
from pileus_service.queue import connect

app = typer.Typer()


@app.command("doctor")
def look_at_health(
    data: Annotated[
        Path | None, typer.Option(envvar="PILEUS_DATA", help="Looks at the farm's folder.")
    ] = None,
    redis: Annotated[
        str | None, typer.Option(envvar="PILEUS_REDIS", help="Looks at Redis.", metavar="URL")
    ] = None,
    root: Annotated[
        list[Path] | None, typer.Option(help="Looks at a folder that shots use; repeatable.")
    ] = None,
    server: Annotated[
        str | None,
        typer.Option(envvar="PILEUS_SERVER", help="Looks at the service.", metavar="URL"),
    ] = None,
    token: Token = None,
    as_json: AsJson = False,
) -> None:
    """Looks at this host and at what it is told of the farm, and says what to mend."""
    findings = [*doctor.host()]
    if data or root:
        findings += doctor.folders(data, root or [])
    if redis:
        findings += doctor.redis_server(connect(redis))
    if data and redis:
        findings += doctor.one_farm(data, connect(redis))
    if server:
        findings += doctor.service(server, token)
    if as_json:
        print(json.dumps([finding.model_dump() for finding in findings]))
    else:
        Console().print(terminal.finding_table(findings))
    if wrong := sum(finding.level == "wrong" for finding in findings):
        raise FarmError(f"{wrong} of {len(findings)} are wrong")
