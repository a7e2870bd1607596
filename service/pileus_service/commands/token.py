"""`pileus token`: makes, lists and revokes the tokens of a data folder."""

import json
import time
from typing import Annotated

import typer

from pileus_service.auth import Role, Tokens
from pileus_service.errors import data_troubles
from pileus_service.options import DATA, AsJson, Data

app = typer.Typer(
    name="token", help="Makes, lists and revokes the service's tokens.", no_args_is_help=True
)
Name = Annotated[str, typer.Argument(metavar="NAME", help="Whose it is: a-z, 0-9 and -.")]


@app.command()
def create(
    name: Name,
    role: Annotated[Role, typer.Option(help="What its bearer may do.")] = Role.SUBMIT,
    data: Data = DATA,
) -> None:
    """Makes a token and shows it, this once."""
    with data_troubles(data):
        print(Tokens(data).create(name, role))


@app.command()
def revoke(name: Name, data: Data = DATA) -> None:
    """Ends a token, at once."""
    with data_troubles(data):
        Tokens(data).revoke(name)
    print(f"{name}: revoked")


@app.command("list")
def list_tokens(
    data: Data = DATA,
    as_json: AsJson = False,
) -> None:
    """Lists the tokens' names, roles and ages; the tokens themselves are not kept."""
    with data_troubles(data):
        tokens = Tokens(data).all()
    if as_json:
        print(json.dumps([token.model_dump(mode="json", exclude={"digest"}) for token in tokens]))
        return
    for token in tokens:
        made = time.strftime("%Y-%m-%d", time.gmtime(token.created))
        print(f"{token.name:20} {token.role:8} made {made}")
