"""What Redis holds of a job and its frames in flight, as a user sees it."""

from collections import Counter
from typing import Literal, TypedDict

from pileus_service.jobs import FrameView, JobState, JobView

FRAME_STATES: dict[str, Literal["planning", "rendering", "merging"]] = {
    "plan": "planning",
    "render": "rendering",
    "merge": "merging",
}


class Row(TypedDict, total=False):
    """A job as views.lua tells it; `reason` is that of the first frame that failed, if any did."""

    held: dict[str, str]
    failed: int
    reason: str
    waiting: int
    flight: dict[str, str]
    active: list[tuple[str, dict[str, str]]]


def job_view(job: str, row: Row, now: float) -> JobView:
    held, failed = row["held"], row["failed"]
    in_flight: Counter[int] = Counter()
    for entry in row["flight"].values():
        frame, done = entry.split()
        in_flight[int(frame)] += int(done)
    active = [_frame_view(int(index), told, in_flight) for index, told in row["active"] if told]
    frames, frames_done = int(held["frames"]), int(held["done"])
    settled = frames_done + failed + sum(frame.progress for frame in active)
    state = JobState(held["state"])
    if state is JobState.RUNNING and "started" not in held:
        state = JobState.QUEUED
    left = None
    gained = settled - int(held["restored"])
    planning = sum(frame.state == "planning" for frame in active)
    # When caches come nobody knows.
    held_up = 0 < row["waiting"] == frames - frames_done - failed - planning
    if state is JobState.RUNNING and gained > 0 and not held_up:
        worked = now - (int(held["started"]) + int(held.get("idle", 0))) / 1000
        left = worked * (frames - settled) / gained
    return JobView(
        id=job,
        name=held["name"],
        state=state,
        priority=int(held["priority"]),
        frames=frames,
        frames_done=frames_done,
        frames_failed=failed,
        progress=settled / frames,
        samples=int(held["samples"]),
        tasks=int(held["tasks"]),
        created=int(held["created"]) / 1000,
        started=int(held["started"]) / 1000 if "started" in held else None,
        finished=int(held["finished"]) / 1000 if "finished" in held else None,
        seconds_left=left,
        # By index as all else here; `Farm` puts in the frame's number.
        reason=f"{held['first_failed']}: {row['reason']}" if "reason" in row else None,
        active=active,
    )


def _frame_view(index: int, held: dict[str, str], in_flight: Counter[int]) -> FrameView:
    total = int(held["total"])
    samples = int(held["samples"]) + in_flight[index]
    return FrameView(
        frame=index,
        state=FRAME_STATES[held["state"]],
        tasks=int(held["tasks"]),
        tasks_done=int(held["done"]),
        progress=min(1.0, samples / total) if total else 0.0,
    )
