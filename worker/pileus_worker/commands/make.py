"""`pileus make`: procedural animated caches."""

import multiprocessing
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Annotated, Literal

import pileus_core as core
import typer

from pileus_service.errors import InputError
from pileus_service.frames import expand, has_pattern, parse_frames
from pileus_service.progress import Display, Row, duration
from pileus_worker import machine
from pileus_worker.errors import plain_errors

app = typer.Typer(
    name="make", help="Makes procedural animated VDB caches, with velocity.", no_args_is_help=True
)

USUAL_LENGTH = 24

Subject = Literal["cloud", "whitewater"]
Frames = Annotated[str, typer.Option(help='The frames, as "1-24".')]
Resolution = Annotated[int, typer.Option(min=8, max=4096, help="Voxels a world unit.")]
Seed = Annotated[int, typer.Option(min=0, help="Another seed, another shape.")]
Length = Annotated[
    int | None,
    typer.Option(
        min=1, help="Frames of the whole action, from 1 on.  [default: 24, or the last frame]"
    ),
]
Out = Annotated[str, typer.Argument(metavar="OUT", help="The files, as caches/cloud.####.vdb.")]


def _command(subject: Subject, what: str) -> None:
    @app.command(subject, help=what)
    def command(
        out: Out,
        frames: Frames = "1-24",
        resolution: Resolution = 256,
        seed: Seed = 0,
        length: Length = None,
    ) -> None:
        make(subject, out, frames, resolution, seed, length)


_command("cloud", "A fractal cumulus that drifts and billows.")
_command("whitewater", "A breaking splash with spray.")


def make(
    subject: Subject,
    out: str,
    frames: str,
    resolution: int,
    seed: int = 0,
    length: int | None = None,
) -> None:
    """Makes the frames in parallel processes. A frame is the same whichever others are made."""
    try:
        numbers = parse_frames(frames)
    except ValueError as error:
        raise InputError(f"--frames {frames}: {error}") from None
    if len(numbers) > 1 and not has_pattern(out):
        raise InputError(
            f"{out}: every frame would write this one file; put #### into the file's name for the "
            "frame's number"
        )
    action = length or max(USUAL_LENGTH, *numbers)
    outside = [number for number in numbers if not 1 <= number <= action]
    if outside:
        raise InputError(
            f"--frames {frames}: frame {outside[0]} lies outside the action, 1 to {action}; "
            "take a frame within it or a greater --length"
        )
    begun = time.monotonic()
    voxels = 0
    with (
        plain_errors(f"make {subject}"),
        Display() as display,
        ProcessPoolExecutor(
            min(machine.cores(), len(numbers)), multiprocessing.get_context("spawn")
        ) as pool,
    ):
        try:
            Path(out).parent.mkdir(parents=True, exist_ok=True)
            jobs = [
                pool.submit(_frame, subject, expand(out, number), number, action, resolution, seed)
                for number in numbers
            ]
            for done, job in enumerate(as_completed(jobs), 1):
                voxels += job.result()
                detail = f"{done} of {len(jobs)} frames"
                display.show(Row(f"making {subject}", done / len(jobs), detail))
        except KeyboardInterrupt:
            # The pool would first finish what it has begun, and Python hears nothing in the core.
            for process in multiprocessing.active_children():
                process.kill()
            raise
    print(
        f"{out}: {len(numbers)} frames, {voxels / len(numbers) / 1e6:.2f} M active voxels a frame, "
        f"{duration(time.monotonic() - begun)}",
        file=sys.stderr,
    )


def _frame(subject: Subject, path: str, frame: int, action: int, resolution: int, seed: int) -> int:
    write = core.make_cloud if subject == "cloud" else core.make_whitewater
    return int(write(path, frame=frame, frames=action, resolution=resolution, seed=seed))
