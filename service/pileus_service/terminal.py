"""Jobs, frames and workers as one likes to see them on a terminal, drawn with rich.

rich reads markup in plain strings: what a user, a worker or a file has named is put into a Text.
"""

import time
from collections.abc import Iterable, Sequence

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from pileus_service.doctor import Finding
from pileus_service.frames import parse_frames
from pileus_service.jobs import FrameMap, FrameView, JobState, JobView, WorkerView
from pileus_service.progress import duration

STYLES = {
    "waiting": "bright_black",
    "planning": "yellow",
    "rendering": "dark_orange",
    "merging": "medium_purple",
    "done": "green",
    "failed": "red",
    "cancelled": "bright_black",
    "queued": "bright_black",
    "paused": "cyan",
    "running": "dark_orange",
}
_LETTERS = {
    ".": ("waiting", "·"),
    "p": ("planning", "○"),
    "r": ("rendering", "◐"),
    "m": ("merging", "◕"),
    "h": ("paused", "◌"),
    "d": ("done", "●"),
    "f": ("failed", "✗"),
    "c": ("cancelled", "-"),
}
ROW = 50
MOST_ROWS = 40
MOST_REASONS = 5


def describe(job: JobView) -> str:
    """How far a job is."""
    text = f"{job.frames_done} of {job.frames} frames"
    if job.frames_failed:
        text += f", {job.frames_failed} failed"
    text += f", {job.samples / 1e6:.1f} M samples"
    return ", ".join(filter(None, (text, time_text(job))))


def in_flight(job: JobView, frame: FrameView) -> str:
    """What becomes of a frame of the job's that has begun."""
    return "paused" if job.state is JobState.PAUSED else frame.state


def state_text(state: str) -> Text:
    return Text(f"● {state}", STYLES[state])


def bar(fraction: float, state: str, width: int | None = 24) -> ProgressBar:
    style = STYLES[state]
    return ProgressBar(1.0, fraction, width, complete_style=style, finished_style=style)


def job_table(jobs: Iterable[JobView]) -> Table:
    """A line a job, the newest first as they come."""
    table = _table("job", "name", "state", "prio", "frames", "done", "time")
    for job in jobs:
        table.add_row(
            job.id,
            Text(job.name),
            state_text(job.state),
            str(job.priority),
            f"{job.frames_done}/{job.frames}",
            f"{job.progress:.0%}",
            time_text(job),
        )
    return table


def time_text(job: JobView) -> str:
    if job.seconds_left is not None:
        return f"{duration(job.seconds_left)} left"
    if job.finished and job.started:
        return f"took {duration(job.finished - job.started)}"
    return ""


def worker_table(workers: Iterable[WorkerView], names: dict[str, str]) -> Table:
    """A line a worker; `names` are the jobs' by their ids, where they are to be told."""
    table = _table("worker", "", "threads", "task", "")
    for worker in workers:
        doing = worker.doing
        if not worker.alive:
            state, task = Text("● gone", "red"), f"last seen {_ago(worker.seen)}"
        elif doing is None and worker.aside is not None:
            state, task = Text("● set aside", "yellow"), worker.aside
        elif doing is None:
            state, task = Text("● idle", "bright_black"), ""
        else:
            state = Text("● at work", "green")
            task = f"{doing.kind} frame {doing.frame}"
            if doing.job in names:
                task += f" of {names[doing.job]}"
        progress: RenderableType = ""
        if doing and doing.bucket and doing.samples:
            task += ", pixels {},{} to {},{}".format(*doing.bucket)
            task += ", samples {} to {}".format(*doing.samples)
            progress = bar(doing.progress, "rendering", 10)
        table.add_row(Text(worker.name), state, str(worker.threads), Text(task), progress)
    return table


def job_picture(
    job: JobView,
    frame_map: FrameMap,
    failed: Sequence[FrameView],
    waiting: Iterable[FrameView],
    workers: Sequence[WorkerView],
) -> Group:
    """A job whole: its progress, its frames as a grid, what is in flight, what is waited for, what
    went wrong."""
    if job.state is JobState.PAUSED:
        held = frame_map.states.translate(str.maketrans("prm", "hhh"))
        frame_map = frame_map.model_copy(update={"states": held})
    head = Table.grid(padding=(0, 2))
    head.add_row(Text(job.name, "bold"), state_text(job.state), Text(job.id, "bright_black"))
    line = Table.grid(padding=(0, 2))
    line.add_row(bar(job.progress, job.state, 20), f"{job.progress:.0%}", describe(job))
    parts: list[RenderableType] = [head, line, "", _grid(frame_map)]
    if job.active:
        parts += ["", _frames(job)]
    here = [worker for worker in workers if worker.doing and worker.doing.job == job.id]
    if here and job.state is JobState.RUNNING:
        parts += ["", worker_table(here, {})]
    for frame in (*waiting, *failed[:MOST_REASONS]):
        text = Text(f"frame {frame.frame}: ", STYLES[frame.state])
        parts.append(Padding(text.append(frame.reason or "", "default"), (1, 0, 0, 0)))
    if len(failed) > MOST_REASONS:
        parts.append(Text(f"and {len(failed) - MOST_REASONS} more that failed", "red"))
    if failed:
        parts.append(Text("`pileus log JOB FRAME` has the attempts", "bright_black"))
    return Group(*parts)


def finding_table(findings: Iterable[Finding]) -> Table:
    """What the doctor found, with the mends below what wants one."""
    marks = {"ok": ("✓", "green"), "warning": ("!", "yellow"), "wrong": ("✗", "red")}
    table = Table.grid(padding=(0, 2))
    for finding in findings:
        mark, style = marks[finding.level]
        found = Text(finding.found)
        if finding.mend:
            found.append(f"\n{finding.mend}", style)
        table.add_row(Text(mark, style), finding.what, found)
    return table


def _grid(frame_map: FrameMap) -> Group:
    """A mark a frame, fifty a row; of a very long shot, a mark stands for several."""
    numbers = parse_frames(frame_map.frames)
    step = -(-len(numbers) // (ROW * MOST_ROWS))
    grid = Table.grid(padding=(0, 1))
    for begin in range(0, len(numbers), ROW * step):
        marks = Text()
        for index in range(begin, min(begin + ROW * step, len(numbers)), step):
            states = frame_map.states[index : index + step]
            name, mark = _LETTERS[next(letter for letter in "frmph.cd" if letter in states)]
            marks.append(mark, STYLES[name])
            if (index // step + 1) % 10 == 0:
                marks.append(" ")
        grid.add_row(Text(str(numbers[begin]), "bright_black", justify="right"), marks)
    key = Text()
    for letter, (name, mark) in _LETTERS.items():
        if letter in frame_map.states:
            key.append(f"{mark} ", STYLES[name]).append(f"{name}   ", "bright_black")
    return Group(grid, key)


def _frames(job: JobView) -> Table:
    table = _table("frame", "", "", "tasks")
    for frame in job.active:
        tasks = f"{frame.tasks_done} of {frame.tasks}" if frame.tasks else ""
        state = in_flight(job, frame)
        told = Text(state, STYLES[state])
        table.add_row(str(frame.frame), told, bar(frame.progress, state), tasks)
    return table


def _ago(when: float) -> str:
    return f"{duration(max(0.0, time.time() - when))} ago"


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bright_black")
    for column in columns:
        table.add_column(column, no_wrap=column not in ("name", "task"))
    return table
