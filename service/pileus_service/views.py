"""What Redis holds of a job and its frames in flight, as a user sees it."""

from collections import Counter
from typing import Literal

from pileus_service.jobs import FrameView, JobState, JobView

FRAME_STATES: dict[str, Literal["planning", "rendering", "merging"]] = {
    "plan": "planning",
    "render": "rendering",
    "merge": "merging",
}


def frame_view(index: int, held: dict[str, str], in_flight: Counter[int]) -> FrameView | None:
    if not held:
        return None
    total = int(held["total"])
    samples = int(held["samples"]) + in_flight[index]
    return FrameView(
        frame=index,
        state=FRAME_STATES[held["state"]],
        tasks=int(held["tasks"]),
        tasks_done=int(held["done"]),
        progress=min(1.0, samples / total) if total else 0.0,
    )


def job_view(
    job: str, held: dict[str, str], failed: dict[str, str], active: list[FrameView], now: float
) -> JobView:
    frames, done = int(held["frames"]), int(held["done"])
    settled = done + len(failed) + sum(frame.progress for frame in active)
    state = JobState(held["state"])
    if state is JobState.RUNNING and "started" not in held:
        state = JobState.QUEUED
    left = None
    gained = settled - int(held["restored"])
    if state is JobState.RUNNING and gained > 0:
        worked = now - (int(held["started"]) + int(held.get("idle", 0))) / 1000
        left = worked * (frames - settled) / gained
    first = min(failed, key=int) if failed else None
    return JobView(
        id=job,
        name=held["name"],
        state=state,
        priority=int(held["priority"]),
        frames=frames,
        frames_done=done,
        frames_failed=len(failed),
        progress=settled / frames,
        samples=int(held["samples"]),
        tasks=int(held["tasks"]),
        created=int(held["created"]) / 1000,
        started=int(held["started"]) / 1000 if "started" in held else None,
        finished=int(held["finished"]) / 1000 if "finished" in held else None,
        seconds_left=left,
        # By index as all else here; `Farm` puts in the frame's number.
        reason=f"{first}: {failed[first]}" if first is not None else None,
        active=active,
    )
