"""Command-line options that several commands take."""

import re
from pathlib import Path
from typing import Annotated

import typer

from pileus_service.errors import InputError

ShotFile = Annotated[Path, typer.Argument(metavar="SHOT", help="The shot, TOML or JSON.")]
Frames = Annotated[str | None, typer.Option(help='Only these, as "1-24x2".')]
Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Overrides a value.")
]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object for scripts.")]


def _sendable(token: str | None) -> str | None:
    """A header holds no other characters, and no token has them."""
    if token is not None and not re.fullmatch(r"[!-~]*", token):
        # Never the token itself: others may look at the terminal.
        raise InputError(
            "--token, PILEUS_TOKEN: is no token; give it as `pileus token create` has shown it"
        )
    return token


Server = Annotated[
    str, typer.Option(envvar="PILEUS_SERVER", help="The service's address.", metavar="URL")
]
Token = Annotated[
    str | None,
    typer.Option(
        envvar="PILEUS_TOKEN", help="The service's token.", metavar="TOKEN", callback=_sendable
    ),
]

Data = Annotated[Path, typer.Option(envvar="PILEUS_DATA", help="The farm's folder.")]
DATA = Path("pileus-data")
Redis = Annotated[str, typer.Option(envvar="PILEUS_REDIS", help="Redis's address.")]
REDIS = "redis://127.0.0.1:6379/0"
RootFolders = Annotated[
    list[Path] | None,
    typer.Option("--root", help="A folder that shots may use; repeatable."),
]
Listen = Annotated[str, typer.Option(metavar="HOST:PORT")]
LISTEN = "127.0.0.1:8765"
