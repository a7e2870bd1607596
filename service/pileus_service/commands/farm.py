"""The commands that ask a farm's service: submit, list, status, log, cancel, pause, resume, retry,
priority, delete, workers, drain."""

import json
import sys
from itertools import islice
from typing import Annotated, Any, Literal

import typer
from pydantic import BaseModel
from rich.console import Console

from pileus_service import terminal
from pileus_service.client import Client
from pileus_service.errors import FarmError, printable
from pileus_service.jobs import TERMINAL, JobState
from pileus_service.options import LISTEN, AsJson, Frames, Server, Sets, ShotFile, Token
from pileus_service.shotfile import load_shot
from pileus_service.watching import picture, show_until_ended, wait_for

JobArgument = Annotated[str, typer.Argument(metavar="JOB", help="The job's id.")]
LOCAL = f"http://{LISTEN}"
NEWEST = 100  # as many as a person looks through

app = typer.Typer()


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
    settings = [*(sets or []), *([f"frames={json.dumps(frames)}"] if frames is not None else [])]
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
        jobs = [*islice(client.jobs(), None if as_json else NEWEST + 1)]
    if as_json:
        _print_json(jobs)
        return
    Console().print(terminal.job_table(jobs[:NEWEST]))
    if len(jobs) > NEWEST:
        print(f"There are more than these {NEWEST}: --json lists all", file=sys.stderr)


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
            print(f"    {printable(text)}")


def _verb(verb: Literal["cancel", "pause", "resume", "retry"], text: str) -> None:
    @app.command(verb, help=text)
    def act(
        job: JobArgument, server: Server = LOCAL, token: Token = None, as_json: AsJson = False
    ) -> None:
        with Client(server, token) as client:
            before = client.job(job)
            view = client.control(job, verb)
        if as_json:
            _print_json(view)
        elif verb == "retry" and before.frames_failed == 0:
            print(f"{view.id}: {view.state}, and no frame failed; nothing to retry")
        elif before.state in TERMINAL and before.state == view.state:
            print(f"{view.id}: {view.state} already; nothing to {verb}")
        else:
            print(f"{view.id}: {view.state}")


_verb("cancel", "Stops a job for good.")
_verb("pause", "Stops a job's work until it is resumed.")
_verb("resume", "Lets a paused job go on.")
_verb("retry", "Renders the failed frames of a job again, and no others.")


@app.command("priority")
def set_priority(
    job: JobArgument,
    priority: Annotated[
        int, typer.Argument(metavar="N", min=0, max=9, help="The higher the sooner.")
    ],
    server: Server = LOCAL,
    token: Token = None,
    as_json: AsJson = False,
) -> None:
    """Changes how urgent a job is."""
    with Client(server, token) as client:
        view = client.set_priority(job, priority)
    if as_json:
        _print_json(view)
    elif view.state in TERMINAL:
        print(f"{view.id}: {view.state} already; its priority stays {view.priority}")
    else:
        print(f"{view.id}: priority {view.priority}")


@app.command()
def delete(
    jobs: Annotated[list[str], typer.Argument(metavar="JOB...", help="The jobs' ids.")],
    server: Server = LOCAL,
    token: Token = None,
) -> None:
    """Stops jobs and removes what the data folder has of them; their images stay."""
    with Client(server, token) as client:
        for job in jobs:
            client.delete(job)
            print(f"{job}: deleted")


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


def _print_json(thing: BaseModel | list[Any]) -> None:
    if isinstance(thing, list):
        print(json.dumps([each.model_dump(mode="json") for each in thing]))
    else:
        print(thing.model_dump_json())
