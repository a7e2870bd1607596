"""The `pileus` program: the client's commands, and the worker's where they are installed."""

import json
import os
import signal
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from pydantic import BaseModel
from rich.console import Console
from typer.core import TyperGroup
from typer.main import get_command

from pileus_service import __version__, doctor, terminal
from pileus_service.client import Client
from pileus_service.errors import FarmError, InputError
from pileus_service.jobs import JobState
from pileus_service.options import (
    DATA,
    LISTEN,
    REDIS,
    AsJson,
    Data,
    Frames,
    Listen,
    Redis,
    RootFolders,
    Sets,
    ShotFile,
)
from pileus_service.queue import connect
from pileus_service.shotfile import load_shot
from pileus_service.watching import picture, show_until_ended, wait_for

Server = Annotated[
    str, typer.Option(envvar="PILEUS_SERVER", help="The service's address.", metavar="URL")
]
Token = Annotated[
    str | None, typer.Option(envvar="PILEUS_TOKEN", help="The service's token.", metavar="TOKEN")
]
JobArgument = Annotated[str, typer.Argument(metavar="JOB", help="The job's id.")]
LOCAL = f"http://{LISTEN}"


class Commands(TyperGroup):
    """The commands of this package and those that other packages register."""

    def list_commands(self, ctx: Any) -> list[str]:
        others = {point.name for point in entry_points(group="pileus.commands")}
        return [*super().list_commands(ctx), *sorted(others)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        for point in entry_points(group="pileus.commands", name=cmd_name):
            try:
                return get_command(point.load())
            except ImportError as error:
                return get_command(_absent(cmd_name, error))
        return super().get_command(ctx, cmd_name)


def _absent(name: str, error: ImportError) -> typer.Typer:
    """Stands for a command whose package is not here, and says what to install."""
    stub = typer.Typer()

    @stub.command(
        name,
        help="Needs the renderer, which is not installed.",
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    )
    def explain() -> None:
        raise FarmError(
            f"pileus {name} needs the renderer: pip install ./core 'pileus[worker]' ({error})"
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


@app.command()
def submit(
    shot: ShotFile,
    server: Server = LOCAL,
    token: Token = None,
    frames: Frames = None,
    sets: Sets = None,
    priority: Annotated[int, typer.Option(min=0, max=9, help="The higher the sooner.")] = 5,
    key: Annotated[str | None, typer.Option(help="Idempotency key: submit once.")] = None,
    webhook: Annotated[
        str | None, typer.Option(metavar="URL", help="Told when the job has ended.")
    ] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Waits until it ends.")] = False,
    wait_for_caches: Annotated[
        bool, typer.Option("--wait-for-caches", help="Caches may still be in the making.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Sends a shot to the farm."""
    settings = [*(sets or []), *([f"frames={json.dumps(frames)}"] if frames else [])]
    with Client(server, token) as client:
        accepted = client.submit(
            load_shot(shot, settings), priority, key, webhook, wait_for_caches=wait_for_caches
        )
        for warning in accepted.warnings:
            print(f"{shot}: warning: {warning}", file=sys.stderr)
        job = accepted.job
        if wait:
            job = wait_for(client, job)
        elif not as_json:
            print(job.id)
    if as_json:
        _print_json(job)
    if job.state in (JobState.FAILED, JobState.CANCELLED):
        raise FarmError(f"{job.id}: {job.state}{f': {job.reason}' if job.reason else ''}")


@app.command("list")
def list_jobs(server: Server = LOCAL, token: Token = None, as_json: AsJson = False) -> None:
    """Lists the jobs, the newest first."""
    with Client(server, token) as client:
        jobs = client.jobs()
    if as_json:
        _print_json(jobs)
        return
    Console().print(terminal.job_table(jobs))


@app.command()
def status(
    job: JobArgument,
    server: Server = LOCAL,
    token: Token = None,
    watch: Annotated[bool, typer.Option("--watch", help="Shows it until the job ends.")] = False,
    as_json: AsJson = False,
) -> None:
    """Shows a job: its frames as a grid, what is in flight, the time left."""
    with Client(server, token) as client:
        if as_json:
            told = client.job(job).model_dump(mode="json")
            told["frames_list"] = [frame.model_dump(mode="json") for frame in client.frames(job)]
            print(json.dumps(told))
        elif watch:
            show_until_ended(client, job)
        else:
            Console().print(picture(client, client.job(job)))


@app.command("log")
def frame_log(
    job: JobArgument,
    frame: Annotated[int, typer.Argument(metavar="FRAME", min=0, help="The frame's number.")],
    server: Server = LOCAL,
    token: Token = None,
    as_json: AsJson = False,
) -> None:
    """Shows what every attempt at a frame had to say."""
    with Client(server, token) as client:
        lines = client.log(job, frame)
    if as_json:
        _print_json(lines)
        return
    for line in lines:
        told = [line.time[:19], line.worker, line.task, line.event]
        told += [f"in {line.seconds:.2f} s"] if line.seconds is not None else []
        told += [line.reason] if line.reason else []
        print("  ".join(told))
        for text in (line.output or "").splitlines():
            print(f"    {text}")


def _verb(verb: Literal["cancel", "pause", "resume", "retry"], text: str) -> None:
    @app.command(verb, help=text)
    def act(
        job: JobArgument, server: Server = LOCAL, token: Token = None, as_json: AsJson = False
    ) -> None:
        with Client(server, token) as client:
            view = client.control(job, verb)
        if as_json:
            _print_json(view)
        else:
            print(f"{view.id}: {view.state}")


_verb("cancel", "Stops a job for good.")
_verb("pause", "Stops a job's work until it is resumed.")
_verb("resume", "Lets a paused job go on.")
_verb("retry", "Renders the failed frames of a job again, and no others.")


@app.command()
def workers(server: Server = LOCAL, token: Token = None, as_json: AsJson = False) -> None:
    """Lists the workers and what they do."""
    with Client(server, token) as client:
        seen = client.workers()
        names = {job.id: job.name for job in client.jobs()}
    if as_json:
        _print_json(seen)
        return
    Console().print(terminal.worker_table(seen, names))


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
    if server:
        findings += doctor.service(server, token)
    if as_json:
        _print_json(findings)
    else:
        Console().print(terminal.finding_table(findings))
    if wrong := sum(finding.level == "wrong" for finding in findings):
        raise FarmError(f"{wrong} of {len(findings)} are wrong")


@app.command()
def drain(
    worker: Annotated[str, typer.Argument(metavar="WORKER", help="Its name, as listed.")],
    server: Server = LOCAL,
    token: Token = None,
    undo: Annotated[bool, typer.Option("--undo", help="Gives it tasks again.")] = False,
) -> None:
    """Gives a worker no more tasks; what it has in hand it finishes."""
    with Client(server, token) as client:
        client.drain(worker, undo=undo)


@app.command()
def service(
    data: Data = DATA,
    redis: Redis = REDIS,
    root: RootFolders = None,
    listen: Listen = LISTEN,
) -> None:
    """Runs the HTTP service alone; workers join it through Redis and the data folder."""
    from pileus_service.server import serve  # a client need not load it

    serve(data, redis, root or [Path.cwd()], listen)


def _print_json(thing: BaseModel | list[Any]) -> None:
    if isinstance(thing, list):
        print(json.dumps([each.model_dump(mode="json") for each in thing]))
    else:
        print(thing.model_dump_json())


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
