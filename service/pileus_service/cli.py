"""The `pileus` program: the client's commands, and the worker's where they are installed."""

import os
import signal
import sys
from importlib.metadata import entry_points
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.main import get_command

from pileus_service import __version__
from pileus_service.errors import FarmError, InputError


class Commands(TyperGroup):
    """The commands that this package and others register, each imported when it is asked for: a
    render should not wait for what a client or a service needs."""

    def list_commands(self, ctx: Any) -> list[str]:
        return sorted({point.name for point in entry_points(group="pileus.commands")})

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        for point in entry_points(group="pileus.commands", name=cmd_name):
            try:
                command = get_command(point.load())
            except ImportError as error:
                return get_command(_absent(cmd_name, error))
            # One of a family of commands, or a command with its own subcommands.
            family = getattr(command, "commands", {})
            return family.get(cmd_name, command)
        return None


def _absent(name: str, error: ImportError) -> typer.Typer:
    """Stands for a command that something is missing for, and says what and what to install."""
    stub = typer.Typer()

    @stub.command(
        name,
        help=f"Cannot start here: {error}.",
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    )
    def explain() -> None:
        raise FarmError(
            f"pileus {name} cannot start: {error}. What renders needs pip install ./core "
            "'pileus[worker]', and the chart 'pileus[bench]' as well"
        )

    return stub


app = typer.Typer(
    cls=Commands,
    help="Renders animated volumes with art-directable multiple scattering, here or on a farm.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.callback(invoke_without_command=True)
def program(
    version: Annotated[bool, typer.Option("--version", help="Says the version and ends.")] = False,
) -> None:
    if version:
        print(__version__)
        raise typer.Exit


def main() -> None:
    """Runs a command; a user's error is one line, never a stack trace."""
    try:
        app()
    except InputError as error:
        _end(f"pileus: {error}", 2)
    except FarmError as error:
        _end(f"pileus: {error}", 1)
    except KeyboardInterrupt:
        _end("pileus: stopped", 128 + signal.SIGINT)
    except BrokenPipeError:
        # The reader has gone, as in `pileus list | head`: nothing is left to say.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def _end(line: str, code: int) -> None:
    print(line, file=sys.stderr)
    sys.exit(code)
