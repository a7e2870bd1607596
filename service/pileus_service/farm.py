"""The farm as the service sees it: the store, which is the truth, and the queue kept true to it."""

import threading
import time
from typing import Literal

import structlog

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
from pileus_service.shotfile import check_files
from pileus_service.store import Store
from pileus_service.webhooks import Webhooks, hooks_from_environment

log = structlog.stdlib.get_logger(__name__)

CHECK_ALL = 30.0
_WISHED: dict[str, Verb] = {"paused": "pause", "running": "resume", "cancelled": "cancel"}


class ConflictError(InputError):
    """The same idempotency key was used for something else."""


class Farm:
    """Submits, steers and shows jobs. Disk first, Redis second: `reconcile` mends the rest."""

    def __init__(
        self, store: Store, queue: Queue, roots: Roots, hooks: Webhooks | None = None
    ) -> None:
        self.store = store
        self.queue = queue
        self.roots = roots
        self.hooks = hooks or hooks_from_environment(store.root)
        self._lock = threading.RLock()
        self._wishes: dict[str, Wish] = {}
        self._agreed: tuple[int, float] | None = None

    def submit(
        self,
        shot: Shot,
        priority: Priority,
        key: str | None,
        webhook: str | None = None,
        wait_for_caches: bool = False,
    ) -> tuple[JobView, bool]:
        """Takes a shot in; with a key, once. Returns the job and whether it is new."""
        shot = shot.anchored(self.roots.first)
        numbers = shot.frame_numbers
        self.roots.check(shot, numbers)
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
        wish = Wish(priority=priority)
        new = self.store.create(job, wish)
        if not new:
            held = self.store.job(job.id)
            if held is not None and held.shot != shot:
                raise ConflictError("Idempotency-Key: was used for another shot; take a new key")
        if new:
            log.info("submitted", job=job.id, name=shot.name, frames=len(numbers))
        view = self.job(job.id)
        assert view is not None
        return view, new

    def control(self, job_id: str, verb: Verb, priority: int = 0) -> JobView | None:
        """Pauses, resumes, cancels a job, changes its priority or retries its failed frames."""
        with self._lock:
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
            self._keep(job_id, wish)
            self.queue.control(job_id, verb, priority)
            log.info(verb, job=job_id, **({"priority": priority} if verb == "priority" else {}))
            return self.job(job_id)

    def _retry(self, view: JobView, wish: Wish) -> JobView | None:
        """Lets the failed frames, and no others, be tried again."""
        if view.frames_failed == 0 or view.state is JobState.CANCELLED:
            return view
        life = wish.life + 1
        state = "paused" if view.state is JobState.PAUSED else "running"
        self._keep(view.id, Wish(state=state, priority=view.priority, life=life))
        self.queue.control(view.id, "retry", life)
        log.info("retry", job=view.id, frames=view.frames_failed)
        return self.job(view.id)

    def remove(self, job_id: str) -> bool:
        with self._lock:
            if self.store.job(job_id) is None:
                return False
            self._wishes.pop(job_id, None)
            # The disk first, or a reconciliation would bring it back.
            self.store.remove(job_id)
            self.queue.control(job_id, "cancel")
            self.queue.control(job_id, "remove")
            log.info("removed", job=job_id)
            return True

    def job(self, job_id: str) -> JobView | None:
        """A job; one that Redis has lost is put back first."""
        view = self.queue.job(job_id)
        if view is None:
            if not self._restore(job_id):
                return None
            view = self.queue.job(job_id)
        return self._numbered(view) if view else None

    def jobs(self, limit: int, offset: int) -> list[JobView]:
        """Newest first."""
        views = self.views(self.queue.job_ids()[::-1][offset : offset + limit])
        return [view for view in views if view]

    def views(self, job_ids: list[str]) -> list[JobView | None]:
        """Several jobs at the cost of about one; None for those that are not here."""
        views = zip(job_ids, self.queue.views(job_ids), strict=True)
        return [self._numbered(view) if view else self.job(job_id) for job_id, view in views]

    def frames(self, job_id: str, limit: int, offset: int) -> list[FrameView] | None:
        job, view = self.store.job(job_id), self.job(job_id)
        if job is None or view is None:
            return None
        failed, waiting = self.queue.failed(job_id), self.queue.waiting(job_id)
        active = {frame.frame: frame for frame in view.active}
        idle: Literal["cancelled", "waiting"] = (
            "cancelled" if view.state is JobState.CANCELLED else "waiting"
        )
        frames = []
        for index, number in list(enumerate(job.shot.frame_numbers))[offset : offset + limit]:
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
        for index in self.queue.failed(job_id):
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

    def reconcile(self) -> None:
        """Makes Redis agree with the disk, and notes on disk how jobs ended. Called each second;
        looks at all jobs only when one has changed, Redis has lost something, or time has passed.
        """
        changes, now = self.queue.changes(), time.monotonic()
        if self._agreed is not None:
            last, at = self._agreed
            if changes == last and now - at < CHECK_ALL:
                return
        # Redis first: what is on no disk by now was removed, and not just submitted.
        standings = self.queue.standings()
        on_disk = set(self.store.job_ids(known=self._wishes))
        for job_id in standings.keys() - on_disk:
            self.queue.control(job_id, "remove")
        # Of many that Redis has lost, those with work to do come back first.
        for job_id in sorted(on_disk, key=lambda each: (self._wish(each).state in TERMINAL, each)):
            self._agree(job_id, standings.get(job_id))
        self.queue.forget_dead()
        self._agreed = changes, now

    def _wish(self, job_id: str) -> Wish:
        wish = self._wishes.get(job_id)
        if wish is None:
            wish = self._wishes[job_id] = self.store.wished(job_id)
        return wish

    def _agree(self, job_id: str, standing: tuple[str, int, int] | None) -> None:
        wish = self._wish(job_id)
        if standing == (wish.state, wish.priority, wish.life):
            return
        with self._lock:
            # Another may have written since; what is on disk now holds.
            self._wishes[job_id] = wish = self.store.wished(job_id)
            standing = self.queue.standing(job_id)
            if standing is None:
                self._restore(job_id)
                return
            state, priority, life = standing
            if life != wish.life or (wish.state in TERMINAL and state != wish.state):
                # A Redis of an earlier day: this job is built anew, what it has finished stays.
                self.queue.control(job_id, "remove")
                self._restore(job_id)
            elif state in TERMINAL:
                if wish.state != state:
                    self._note_end(job_id, state)
            else:
                if wish.state != state:
                    self.queue.control(job_id, _WISHED[wish.state])
                if wish.priority != priority:
                    self.queue.control(job_id, "priority", wish.priority)

    def _restore(self, job_id: str) -> bool:
        """Puts a job of the disk into Redis; what it has finished stays finished."""
        job = self.store.job(job_id)
        if job is None:
            return False
        done = self.store.done_frames(job)
        wish = self.store.wished(job_id)
        frames = len(job.shot.frame_numbers)
        self.queue.submit(job_id, job.shot.name, job.created, frames, wish, done)
        return True

    def _note_end(self, job_id: str, state: str) -> None:
        view = self.queue.job(job_id)
        if view is not None:
            wish = Wish.model_validate(
                {
                    "state": state,
                    "priority": view.priority,
                    "life": self._wishes[job_id].life,
                    "finished": view.finished,
                    "failed": self.queue.failed(job_id),
                }
            )
            self._keep(job_id, wish)
            log.info("ended", job=job_id, state=state, failed=len(wish.failed))

    def _keep(self, job_id: str, wish: Wish) -> None:
        job = self.store.job(job_id) if wish.state in TERMINAL else None
        if job is not None:
            # First the notice: an end that is on disk is not looked at again.
            self.hooks.note_end(job, wish)
        self.store.wish(job_id, wish)
        self._wishes[job_id] = wish

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
