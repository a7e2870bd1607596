"""The farm as the service sees it: the store, which is the truth, and the queue kept true to it."""

import shutil
import time
from typing import Literal

import structlog
from redis.exceptions import RedisError

from pileus_service.agreement import Agreement
from pileus_service.errors import InputError
from pileus_service.jobs import (
    TERMINAL,
    Doing,
    Done,
    FrameMap,
    FrameView,
    Job,
    JobState,
    JobView,
    Kind,
    Priority,
    Wish,
    WorkerView,
    id_for_key,
    new_id,
)
from pileus_service.queue import Queue, Verb
from pileus_service.roots import Roots
from pileus_service.shot import Shot
from pileus_service.shotfile import check_camera, check_files
from pileus_service.store import Store
from pileus_service.webhooks import Webhooks, hooks_from_environment

log = structlog.stdlib.get_logger(__name__)


class ConflictError(InputError):
    """The same idempotency key was used for something else, or is being removed."""


class Farm:
    """Submits, steers and shows jobs. Disk first, Redis second: `Agreement` mends the rest."""

    def __init__(
        self, store: Store, queue: Queue, roots: Roots, hooks: Webhooks | None = None
    ) -> None:
        self.store = store
        self.queue = queue
        self.roots = roots
        self.hooks = hooks or hooks_from_environment(store.root)
        self.agreement = Agreement(store, queue, self.hooks)

    def submit(
        self,
        shot: Shot,
        priority: Priority,
        key: str | None,
        webhook: str | None = None,
        wait_for_caches: bool = False,
    ) -> tuple[JobView, bool]:
        """Takes a shot in; with a key, once. Returns the job and whether it is new."""
        self.agreement.check()  # a job in a folder that is not the farm's would be lost
        shot = shot.anchored(self.roots.first)
        numbers = shot.frame_numbers
        self.roots.check(shot, numbers)
        check_camera(shot, shot.name, numbers)
        check_files(shot, shot.name, numbers, caches=not wait_for_caches)
        if webhook is not None:
            self.hooks.check(webhook)
        job = Job(
            id=id_for_key(key) if key else new_id(),
            created=time.time(),
            shot=shot,
            webhook=webhook,
            wait_for_caches=wait_for_caches,
        )
        # No life of a job that had the same key before: a Redis of that day is not to be believed.
        wish = Wish(priority=priority, life=int(job.created * 1000))
        new = self.store.create(job, wish)
        if not new:
            held = self.store.job(job.id)
            if held is not None and held.shot != shot:
                raise ConflictError("Idempotency-Key: was used for another shot; take a new key")
        if new:
            log.info("submitted", job=job.id, name=shot.name, frames=len(numbers))
        try:
            view = self.job(job.id)
        except RedisError as error:
            if not new:
                raise
            # What is on disk is taken: `Agreement` brings it to Redis, and asked to try again the
            # client would make another of it.
            log.warning("submitted without Redis", job=job.id, reason=str(error))
            view = _queued(job, priority)
        if view is None:
            raise ConflictError("The job was removed as it came; submit it anew")
        return view, new

    def control(self, job_id: str, verb: Verb, priority: int = 0) -> JobView | None:
        """Pauses, resumes, cancels a job, changes its priority or retries its failed frames."""
        with self.agreement.lock:
            view = self.job(job_id)
            if view is None:
                return None
            wish = self.store.wished(job_id)
            if verb == "retry":
                return self._retry(view, wish)
            if view.state in TERMINAL:
                return view
            if verb == "priority":
                wish = wish.model_copy(update={"priority": priority})
            else:
                state = {"pause": "paused", "resume": "running", "cancel": "cancelled"}[verb]
                wish = wish.model_copy(update={"state": state})
            self.agreement.keep(job_id, wish)
            self.queue.control(job_id, verb, priority)
            log.info(verb, job=job_id, **({"priority": priority} if verb == "priority" else {}))
            return self.job(job_id)

    def _retry(self, view: JobView, wish: Wish) -> JobView | None:
        """Lets the failed frames, and no others, be tried again."""
        if view.frames_failed == 0 or view.state is JobState.CANCELLED:
            return view
        life = wish.life + 1
        state = "paused" if view.state is JobState.PAUSED else "running"
        self.agreement.keep(view.id, Wish(state=state, priority=view.priority, life=life))
        self.queue.control(view.id, "retry", life)
        log.info("retry", job=view.id, frames=view.frames_failed)
        return self.job(view.id)

    def remove(self, job_id: str) -> bool:
        with self.agreement.lock:
            if self.store.job(job_id) is None:
                return False
            self.agreement.forget(job_id)
            # The disk first, or a reconciliation would bring it back.
            gone = self.store.forget(job_id)
            self.queue.control(job_id, "remove")
            log.info("removed", job=job_id)
        shutil.rmtree(gone, ignore_errors=True)  # of ten thousand partials: nobody waits for that
        return True

    def job(self, job_id: str) -> JobView | None:
        """A job; one that Redis has lost is put back first."""
        view = self.queue.job(job_id)
        if view is None:
            if not self.agreement.restore(job_id):
                return None
            view = self.queue.job(job_id)
        return self._numbered(view) if view else None

    def jobs(self, limit: int, offset: int) -> list[JobView]:
        """Newest first."""
        views = self.views(self.queue.job_ids(limit, offset))
        return [view for view in views if view]

    def views(self, job_ids: list[str]) -> list[JobView | None]:
        """Several jobs at the cost of about one; None for those that are not here."""
        views = zip(job_ids, self.queue.views(job_ids), strict=True)
        return [self._numbered(view) if view else self.job(job_id) for job_id, view in views]

    def frames(self, job_id: str, limit: int, offset: int) -> list[FrameView] | None:
        job, view = self.store.job(job_id), self.job(job_id)
        if job is None or view is None:
            return None
        page = list(enumerate(job.shot.frame_numbers))[offset : offset + limit]
        failed = self.queue.failed(job_id, [index for index, _ in page])
        waiting = self.queue.waiting(job_id)
        active = {frame.frame: frame for frame in view.active}
        idle: Literal["cancelled", "waiting"] = (
            "cancelled" if view.state is JobState.CANCELLED else "waiting"
        )
        frames = []
        for index, number in page:
            if number in active:
                frames.append(active[number])
            elif index in failed:
                frames.append(FrameView(frame=number, state="failed", reason=failed[index]))
            elif done := self.store.frame(job_id, number).done():
                frames.append(
                    FrameView(
                        frame=number,
                        state="done",
                        progress=1.0,
                        file=done.file,
                        seconds=done.seconds,
                        reason=done.reason,
                        bounded_paths=done.bounded_paths,
                        unmet_buckets=done.unmet_buckets,
                        warnings=done.warnings,
                    )
                )
            else:
                frames.append(FrameView(frame=number, state=idle, reason=waiting.get(index)))
        return frames

    def frame_map(self, job_id: str) -> FrameMap | None:
        """Every frame's state, from Redis alone: cheap enough to be asked for often."""
        job, view = self.store.job(job_id), self.job(job_id)
        if job is None or view is None:
            return None
        active = {frame.frame: frame.state[0] for frame in view.active}
        letters = ["c" if view.state is JobState.CANCELLED else "."] * view.frames
        for index in self.queue.done(job_id):
            letters[index] = "d"
        for index in self.queue.failed_frames(job_id):
            letters[index] = "f"
        for index, number in enumerate(job.shot.frame_numbers):
            letters[index] = active.get(number, letters[index])
        image = job.shot.image
        return FrameMap(
            frames=job.shot.frames,
            states="".join(letters),
            width=image.width,
            height=image.height,
        )

    def workers(self) -> list[WorkerView]:
        """The workers, each with its task in a user's words."""
        workers = self.queue.workers()
        # Those at one frame one after another, so that its plan is parsed once.
        at_work = sorted(
            (worker for worker in workers if worker.alive and worker.task),
            key=lambda worker: (worker.task.job, worker.task.frame) if worker.task else ("", 0),
        )
        doing = {worker.name: self._doing(worker) for worker in at_work}
        return [worker.model_copy(update={"doing": doing.get(worker.name)}) for worker in workers]

    def _doing(self, worker: WorkerView) -> Doing | None:
        task = worker.task
        job = self.store.job(task.job) if task else None
        if task is None or job is None:
            return None
        frame = job.shot.frame_numbers[task.frame]
        doing = Doing(job=task.job, frame=frame, kind=task.kind)
        plan = self.store.frame(task.job, frame).plan() if task.kind is Kind.RENDER else None
        if plan is None or task.part >= len(plan.parts):
            return doing
        part = plan.parts[task.part]
        progress = min(1.0, worker.samples / max(1, part.pixel_samples))
        told = {"bucket": part.bucket, "samples": part.samples, "progress": progress}
        return doing.model_copy(update=told)

    def done(self, job_id: str, frame: int) -> Done | None:
        return self.store.frame(job_id, frame).done() if self.store.job(job_id) else None

    def _numbered(self, view: JobView) -> JobView:
        """Puts frame numbers in the place of indices."""
        job = self.store.job(view.id) if view.active or view.reason else None
        if job is None:
            return view.model_copy(update={"active": []})
        numbers = job.shot.frame_numbers
        active = [frame.model_copy(update={"frame": numbers[frame.frame]}) for frame in view.active]
        reason = view.reason
        if reason is not None:
            index, _, why = reason.partition(": ")
            reason = f"frame {numbers[int(index)]}: {why}"
        return view.model_copy(update={"active": active, "reason": reason})


def _queued(job: Job, priority: Priority) -> JobView:
    """A new job that Redis does not know yet."""
    return JobView(
        id=job.id,
        name=job.shot.name,
        state=JobState.QUEUED,
        priority=priority,
        frames=len(job.shot.frame_numbers),
        frames_done=0,
        frames_failed=0,
        progress=0.0,
        samples=0,
        tasks=0,
        created=job.created,
    )
