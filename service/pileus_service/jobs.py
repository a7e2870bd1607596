"""What the service and the workers say to each other: jobs, frames, tasks and their results."""

import hashlib
import re
import secrets
import time
from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from pileus_service import __version__
from pileus_service.shot import Shot

Priority = Annotated[int, Field(ge=0, le=9, strict=True)]
JOB_ID = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")
NEW_ID = re.compile(r"\d{8}-\d{6}-[0-9a-f]{8}")
JobId = Annotated[str, StringConstraints(pattern=rf"^{JOB_ID.pattern}$")]
Bucket = tuple[int, int, int, int]
# Of a job's files, tasks and keys. A worker takes jobs up to its own format, so raise it when an
# older worker would misread a newer job; a further field that may be ignored needs none.
FORMAT = 1
TERMINAL = frozenset({"done", "failed", "cancelled"})


class Record(BaseModel):
    """A message or a file of the farm's own; a newer program's may say more than we know."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class FarmMark(Record):
    """By which programs know that they share one data folder."""

    id: str


class JobState(StrEnum):
    QUEUED = "queued"
    RUNNING = "running"
    PAUSED = "paused"
    CANCELLED = "cancelled"
    FAILED = "failed"
    DONE = "done"


class Kind(StrEnum):
    PLAN = "plan"
    RENDER = "render"
    MERGE = "merge"


class Cause(StrEnum):
    """Why an attempt failed, as it is counted. A lease that ran out is counted by the queue."""

    INPUT = "input"
    DISK = "disk"
    MEMORY = "memory"
    CRASH = "crash"
    HANG = "hang"
    ERROR = "error"


class Job(Record):
    """A job as it was submitted: job.json. One that waits for its caches plans a frame only when
    its cache is there and no longer grows."""

    id: JobId
    created: float
    shot: Shot
    webhook: str | None = None
    wait_for_caches: bool = False


class Wish(Record):
    """What is wanted of a job and how it ended: state.json, written by the service alone.

    A job's making and each retry begin a new life; where Redis knows an older one, it is not to be
    believed.
    """

    state: Literal["running", "paused", "cancelled", "failed", "done"] = "running"
    priority: Priority = 5
    life: int = 0
    finished: float | None = None
    failed: dict[int, str] = {}


class Cache(Record):
    """A file that a frame reads, a cache or a texture, as it was when the frame was planned; its
    path is the shot's."""

    path: str
    mtime_ns: int
    size: int


class Look(Record):
    """Caches as they were found where a frame waits for them."""

    caches: list[Cache] = []


class Part(Record):
    """A render task: samples [first, last) of a bucket of pixels."""

    bucket: Bucket
    samples: tuple[int, int]

    @property
    def name(self) -> str:
        return "-".join(map(str, self.bucket)) + ".{}-{}.exr".format(*self.samples)

    @property
    def pixel_samples(self) -> int:
        x0, y0, x1, y1 = self.bucket
        return (x1 - x0) * (y1 - y0) * (self.samples[1] - self.samples[0])


class Resolved(Record):
    """The transport of a frame as it was decided, and why."""

    method: str
    max_bounces: int | None
    reduce_from: int
    # The RMS relative error that the frame's noise may have; None takes all samples.
    noise: float | None = None
    opacity: float = 1.0  # the frame's mean, by which its buckets share that error out
    reason: str


class Plan(Record):
    """How a frame is rendered: plan.json. The empty buckets are left to the merge."""

    frame: int
    identity: str
    cache: Cache
    textures: list[Cache] = []
    transport: Resolved
    parts: list[Part]
    empty: list[Bucket]
    begun: float
    warnings: list[str] = []  # what is odd in the files, and how it is taken

    @property
    def files(self) -> list[Cache]:
        """What the frame reads."""
        return [self.cache, *self.textures]


class Done(Record):
    """A frame that is finished: done.json, written after the image and before any clean-up."""

    frame: int
    file: str
    seconds: float
    samples: int
    method: str
    max_bounces: int | None
    reason: str
    bounded_paths: int = 0
    unmet_buckets: int = 0
    warnings: list[str] = []


class Task(Record):
    """A task that a worker holds the lease of. `frame` is an index into the shot's frames."""

    priority: Priority
    entry: str
    attempt: int
    job: JobId
    frame: int
    kind: Kind
    part: int

    @property
    def label(self) -> str:
        """What it is of its frame: plan, render 7, merge."""
        return f"{self.kind} {self.part}" if self.kind is Kind.RENDER else str(self.kind)

    def __str__(self) -> str:
        return f"{self.job} frame[{self.frame}] {self.label}"


class Planned(Record):
    """A plan's result; parts already on disk are finished and not rendered again. The same version
    of Pileus renders the parts, as another's might differ in their bits."""

    version: str = __version__
    tasks: int
    finished: list[int]
    total: int
    samples: int


class Rendered(Record):
    """A part's result: its pixel samples as planned, by which progress is told, and those that were
    taken, which are fewer where a tolerance was met."""

    samples: int
    taken: int


class Merged(Record):
    """A merge's result: parts to render again because they are missing or damaged, if any."""

    redo: list[int] = []
    reason: str = ""


class Replan(Record):
    """What comes of a part or a merge whose plan is of a version that no worker is of any more."""

    replan: Literal[True] = True


class Waiting(Record):
    """In the place of a plan: the cache is not ready, and is looked for again after a while."""

    wait: str


class Stale(Record):
    """In the place of a result: what the plan says of the cache holds no longer; plan anew."""

    stale: str


Result = Planned | Rendered | Merged | Replan | Waiting | Stale


class WorkerInfo(Record):
    """A worker as it describes itself with every renewal."""

    name: str
    host: str
    pid: int
    threads: int
    started: float
    version: str = __version__
    task: Task | None = None
    samples: int = 0


class Doing(Record):
    """A worker's task in a user's words: the frame by its number, what of it (with a tolerance the
    samples are the most that it may take), how far."""

    job: JobId
    frame: int
    kind: Kind
    bucket: Bucket | None = None
    samples: tuple[int, int] | None = None
    progress: float = 0.0


class WorkerView(WorkerInfo):
    """A worker as the service shows it; `aside` says why it gets no tasks, where it gets none."""

    seen: float
    alive: bool
    doing: Doing | None = None
    aside: str | None = None


class FrameView(Record):
    """A frame as the service shows it."""

    frame: int
    state: Literal["waiting", "planning", "rendering", "merging", "done", "failed", "cancelled"]
    tasks: int = 0
    tasks_done: int = 0
    progress: float = 0.0
    reason: str | None = None
    file: str | None = None
    seconds: float | None = None
    bounded_paths: int = 0
    unmet_buckets: int = 0
    warnings: list[str] = []


class FrameMap(Record):
    """The state of every frame of a job, a letter each, in rising order of `frames`: waiting (.),
    planning, rendering, merging, done, failed, cancelled (their first letters). `width` and
    `height` are the image's, in pixels."""

    frames: str
    states: str
    width: int
    height: int


class JobView(Record):
    """A job as the service shows it."""

    id: JobId
    name: str
    state: JobState
    priority: Priority
    frames: int
    frames_done: int
    frames_failed: int
    progress: float
    samples: int
    tasks: int
    created: float
    started: float | None = None
    finished: float | None = None
    seconds_left: float | None = None
    reason: str | None = None
    active: list[FrameView] = []


def new_id() -> str:
    """An id that sorts by time and cannot be guessed from another."""
    return time.strftime("%Y%m%d-%H%M%S-", time.gmtime()) + secrets.token_hex(4)


def id_for_key(key: str) -> str:
    """The id of a submission with an idempotency key: the same key is the same job. A new id, as
    the client makes one, is its own."""
    if NEW_ID.fullmatch(key):
        return key
    return "key-" + hashlib.sha256(key.encode()).hexdigest()[:24]
