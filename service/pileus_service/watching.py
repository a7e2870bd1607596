"""Follows a job until it ends, with progress."""

from pileus_service.client import Client
from pileus_service.jobs import FrameView, JobView
from pileus_service.progress import Display, Row, duration


def wait_for(client: Client, job: JobView) -> JobView:
    """Shows a job until it ends, its frames in flight below it; returns it as it ended."""
    with Display() as display:
        for view in client.watch(job.id):
            job = view
            whole = Row(job.name, job.progress, describe(job))
            display.show(whole, *map(_frame_row, job.active))
        display.note(f"{job.name}: {job.state}, {describe(job)}")
    return job


def _frame_row(frame: FrameView) -> Row:
    tasks = f"{frame.tasks_done} of {frame.tasks} tasks" if frame.tasks else ""
    return Row(f"  frame {frame.frame}", frame.progress, f"{frame.state} {tasks}")


def describe(job: JobView) -> str:
    """How far a job is."""
    text = f"{job.frames_done} of {job.frames} frames"
    if job.frames_failed:
        text += f", {job.frames_failed} failed"
    text += f", {job.samples / 1e6:.1f} M samples"
    if job.seconds_left is not None:
        text += f", {duration(job.seconds_left)} left"
    elif job.finished and job.started:
        text += f", took {duration(job.finished - job.started)}"
    return text
