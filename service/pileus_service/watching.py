"""Follows a job until it ends, with progress."""

from itertools import takewhile

from rich.console import Console, Group
from rich.live import Live

from pileus_service import terminal
from pileus_service.client import Client
from pileus_service.frames import parse_frames
from pileus_service.jobs import FrameView, JobView
from pileus_service.progress import Display, Row
from pileus_service.terminal import describe, in_flight


def wait_for(client: Client, job: JobView) -> JobView:
    """Shows a job until it ends, its frames in flight below it; returns it as it ended."""
    with Display() as display:
        try:
            display.note(f"{job.id}: taken")
            for view in client.watch(job.id):
                job = view
                whole = Row(job.name, job.progress, describe(job))
                display.show(whole, *(_frame_row(job, frame) for frame in job.active))
        except KeyboardInterrupt:
            display.note(f"{job.id} goes on; `pileus status {job.id}` shows it")
            raise
        display.note(f"{job.name}: {job.state}, {describe(job)}")
    return job


def _frame_row(job: JobView, frame: FrameView) -> Row:
    tasks = f"{frame.tasks_done} of {frame.tasks} tasks" if frame.tasks else ""
    return Row(f"  frame {frame.frame}", frame.progress, f"{in_flight(job, frame)} {tasks}")


def picture(client: Client, job: JobView) -> Group:
    """A job with its frames and the workers that are at it."""
    frame_map = client.frame_map(job.id)
    numbers = parse_frames(frame_map.frames)
    wrong = [index for index, state in enumerate(frame_map.states) if state == "f"]
    failed = [client.frame(job.id, index) for index in wrong[: terminal.MOST_REASONS]]
    failed += [FrameView(frame=numbers[i], state="failed") for i in wrong[terminal.MOST_REASONS :]]
    idle = [index for index, state in enumerate(frame_map.states) if state == "."]
    first = (client.frame(job.id, index) for index in idle[: terminal.MOST_REASONS])
    # Frames begin in order: those after one that waits for nothing but its turn have not begun.
    waiting = [*takewhile(lambda frame: frame.state == "waiting" and frame.reason, first)]
    return terminal.job_picture(job, frame_map, failed, waiting, client.workers())


def show_until_ended(client: Client, job: str) -> None:
    """Draws a job anew twice a second until it ends."""
    with Live(console=Console(), auto_refresh=False) as live:
        for view in client.watch(job):
            live.update(picture(client, view), refresh=True)
