"""What a render child does: plans a frame, renders a part of one, merges one."""

import contextlib
import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pileus_core as core

from pileus_service.errors import printable
from pileus_service.jobs import (
    Bucket,
    Cache,
    Done,
    Job,
    Kind,
    Merged,
    Part,
    Plan,
    Planned,
    Rendered,
    Replan,
    Resolved,
    Result,
    Stale,
    Waiting,
)
from pileus_service.roots import Roots
from pileus_service.store import FrameStore, Store, sync_folder
from pileus_worker import deciding, planning, scene
from pileus_worker.caches import Caches
from pileus_worker.denoising import check_installed, denoise
from pileus_worker.paths import PathMap
from pileus_worker.pictures import write_preview
from pileus_worker.sampling import Sampler

# A cache that nobody has written to for so long is whole.
SETTLED_SECONDS = 60.0


class StaleError(Exception):
    """The plan speaks of a cache that is there no longer."""


@dataclass
class Work:
    """One task, with all it needs to be done in.

    `permit` is called before a frame is put in its place, and raises unless the task is still
    ours: a worker that was frozen must not write over what others have done since.
    """

    store: Store
    roots: Roots
    caches: Caches
    threads: int
    task_seconds: float
    job: Job
    frame: int
    kind: Kind
    part: int
    paths: PathMap
    permit: Callable[[], None]
    read_ahead: bool
    control: core.Control = field(default_factory=core.Control)
    phases: dict[str, float] = field(default_factory=dict)
    # What gets somewhere and renders nothing: phases begun, partials read, looks denoised.
    steps: int = 0

    def run(self) -> Result:
        self.roots.check(self.paths.shot(self.job.shot), [self.frame])
        files = self.store.frame(self.job.id, self.frame)
        files.look_again()
        if files.done() is not None:
            return self._already_done(files)
        try:
            if self.kind is Kind.PLAN:
                return self._plan(files)
            plan = files.plan()
            if plan is None:
                return Stale(stale=f"frame {self.frame}: its plan is gone from the data folder")
            if plan.identity != scene.identity(self.job.shot, self.frame, plan.files):
                return Replan()
            if self.kind is Kind.RENDER:
                return self._render(files, plan)
            return self._merge(files, plan)
        except StaleError as error:
            return Stale(stale=str(error))

    def _already_done(self, files: FrameStore) -> Result:
        """What Redis forgot, or an attempt that died before it could say so or clean up."""
        self._tidy(files)
        if self.kind is Kind.PLAN:
            return Planned(tasks=0, finished=[], total=0, samples=0)
        return Rendered(samples=0, taken=0) if self.kind is Kind.RENDER else Merged()

    def _plan(self, files: FrameStore) -> Planned | Waiting:
        """Makes the frame's plan, or takes up one that is there, with what it has finished."""
        check_installed(self.job.shot, self.job.shot.name)
        if self.job.wait_for_caches and (trouble := self._unready(files)):
            return Waiting(wait=trouble)
        read = scene.files_of(self.job.shot, self.frame, self.paths)
        identity = scene.identity(self.job.shot, self.frame, read)
        plan = files.plan()
        if plan is not None and plan.identity != identity:
            files.drop_plan()
            plan = None
        if plan is None:
            try:
                plan = files.keep_plan(self._new_plan(read, identity))
            except core.InputError as error:
                if self.job.wait_for_caches and self._fresh(files, files.seen()):
                    return Waiting(wait=str(error))
                raise
        there = files.parts()
        finished = [i for i, part in enumerate(plan.parts) if part.name in there]
        return Planned(
            tasks=len(plan.parts),
            finished=finished,
            total=sum(part.pixel_samples for part in plan.parts),
            samples=sum(plan.parts[i].pixel_samples for i in finished),
        )

    def _unready(self, files: FrameStore) -> str | None:
        """Why a cache is not to be read yet: it is absent, or has changed since the last look."""
        shot, first, frames = self.job.shot, self._first, [self.frame]
        if first is not None and self.store.frame(self.job.id, first).plan() is None:
            frames.append(first)  # it is measured for this one
        caches = []
        for frame in frames:
            path = scene.cache_path(self.paths.shot(shot), frame)
            if not path.exists():
                return f"volumes.0.cache: {path} is not there yet"
            caches.append(scene.cache_of(shot, frame, self.paths))
        seen = files.seen()
        for cache in self._fresh(files, caches):
            if cache not in seen:
                here = self.paths.here(cache.path)
                return f"volumes.0.cache: {here} may still be in the making"
        return None

    def _fresh(self, files: FrameStore, caches: list[Cache]) -> list[Cache]:
        """Which of the caches were written to within the time after which they count as whole. A
        look at them is kept with the frame: that tells the file server's time, not this host's."""
        now = files.mark_seen(caches)
        return [cache for cache in caches if now - cache.mtime_ns / 1e9 <= SETTLED_SECONDS]

    def _new_plan(self, read: list[Cache], identity: str) -> Plan:
        begun = time.time()
        shot = self.job.shot
        warnings: list[str] = []
        view = self._scene(read, lambda told: warnings.append(printable(told)))
        for warning in warnings:
            print(f"warning: {warning}", flush=True)  # for the frame's log
        cache, *textures = read
        size = (shot.image.width, shot.image.height)
        samples = shot.sampling.samples
        with self._phase("plan"):
            resolved = self._resolve(cache)
            if resolved.noise is not None:
                parts, empty = planning.even(view, size, samples)
            else:
                cost = planning.measure(
                    view,
                    scene.make_transport(shot, resolved),
                    size,
                    seed=shot.sampling.seed,
                    frame=self.frame,
                    threads=self.threads,
                    control=self.control,
                )
                parts, empty = planning.cut(view, cost, size, samples, self.task_seconds)
        return Plan(
            frame=self.frame,
            identity=identity,
            cache=cache,
            textures=textures,
            transport=resolved,
            parts=parts,
            empty=empty,
            begun=begun,
            warnings=warnings,
        )

    @property
    def _first(self) -> int | None:
        """The shot's first frame, in the light of which `auto` decides the others."""
        first = self.job.shot.frame_numbers[0]
        auto = self.job.shot.transport.method == "auto"
        return first if auto and first != self.frame else None

    def _resolve(self, cache: Cache) -> Resolved:
        """This frame's transport; the first frame's is measured now unless its plan tells it."""
        first, earlier = self._first, None
        if first is not None:
            plan = self.store.frame(self.job.id, first).plan()
            earlier = (
                self._decide(first, scene.cache_of(self.job.shot, first, self.paths), None)
                if plan is None
                else plan.transport
            )
        return self._decide(self.frame, cache, earlier)

    def _decide(self, frame: int, cache: Cache, earlier: Resolved | None) -> Resolved:
        shot = self.job.shot
        return deciding.resolve(
            self.paths.shot(shot),
            frame,
            lambda: self.caches.get(cache, shot.volumes[0].density),
            threads=self.threads,
            control=self.control,
            earlier=earlier,
            reading=self.roots.reading,
        )

    def _render(self, files: FrameStore, plan: Plan) -> Rendered:
        part = plan.parts[self.part]
        path = files.part(part)
        partial = self._whole(files, part, plan)
        if partial is None:
            view = self._scene(plan.files)
            if self.read_ahead:
                self._begin_next()
            # Only where the frame's folder is: a job that was removed leaves nothing behind.
            path.parent.mkdir(exist_ok=True)
            partial = self._samples(view, plan, part.bucket, part.samples)
            with self._phase("write"):
                partial.write(str(path), plan.identity)
            if files.done() is not None:
                self._tidy(files)  # we were late, and others have swept already
        taken = part.model_copy(update={"samples": partial.samples})
        return Rendered(samples=part.pixel_samples, taken=taken.pixel_samples)

    def _merge(self, files: FrameStore, plan: Plan) -> Merged:
        """Writes the image from the partials; those missing or damaged are to be made again."""
        shot = self.job.shot
        samples = shot.sampling.samples if plan.transport.noise is None else None
        buckets = [*dict.fromkeys(part.bucket for part in plan.parts), *plan.empty]
        frame = core.Frame(
            shot.image.width, shot.image.height, [(bucket, samples) for bucket in buckets]
        )
        redo, trouble = [], ""
        with self._phase("merge"):
            for index, part in enumerate(plan.parts):
                self._step()
                try:
                    partial = self._read(files, part, plan)
                except core.InputError as error:
                    redo.append(index)
                    trouble = str(error)
                else:
                    # After a gap the frame takes no more; the others are still looked through.
                    if not redo:
                        frame.add(partial)
        if redo:
            return Merged(redo=redo, reason=trouble)
        for partial in self._empty_buckets(plan):
            frame.add(partial)
        with self._phase("denoise"):
            denoise(frame, shot, self.threads, self._step)
        with self._phase("write"):
            self._write(files, plan, frame)
        return Merged()

    def _empty_buckets(self, plan: Plan) -> Iterator[core.Partial]:
        if plan.empty:
            view = self._scene(plan.files)
            for bucket in plan.empty:
                yield self._samples(view, plan, bucket, (0, self.job.shot.sampling.samples))

    def _write(self, files: FrameStore, plan: Plan, frame: core.Frame) -> None:
        shot, resolved = self.job.shot, plan.transport
        seconds = time.time() - plan.begun
        place = self.roots.writing(self.paths.shot(shot).output(self.frame))
        staging = self.roots.writing(self._staging / f"{os.getpid()}.exr")
        with place as location, staging as staged:
            frame.write(
                staged,
                half=shot.image.pixel_type == "half",
                header=scene.header(shot, self.frame, resolved, seconds, frame),
            )
            self.permit()
            Path(staged).replace(location)
            sync_folder(Path(location).parent)
        write_preview(files.preview, frame.pixels(shot.transport.looks[0].name))
        files.mark_done(
            Done(
                frame=self.frame,
                file=str(shot.output(self.frame)),
                seconds=seconds,
                samples=round(frame.mean_samples),
                method=resolved.method,
                max_bounces=resolved.max_bounces,
                reason=resolved.reason,
                bounded_paths=frame.bounded_paths,
                unmet_buckets=frame.unmet_buckets,
                warnings=plan.warnings,
            )
        )
        self._tidy(files)

    @property
    def _staging(self) -> Path:
        """Where the frame's image is written before it is renamed: beside it, to be one rename
        away, and a folder, so that what a killed attempt left there is found without a search."""
        output = self.paths.shot(self.job.shot).output(self.frame)
        return output.parent / f".{self.job.id}.{self.frame}"

    def _tidy(self, files: FrameStore) -> None:
        """Sweeps, once the frame is done, what its attempts have left."""
        files.sweep()
        shutil.rmtree(self._staging, ignore_errors=True)

    def _scene(
        self, read: list[Cache], warn: Callable[[str], None] = lambda warning: None
    ) -> core.Scene:
        """The scene of its files as they were planned: asked before and after they are read, so
        that no frame is of two caches or textures."""
        shot = self.job.shot
        try:
            self._same(read)
            with self._phase("load"):
                volume = self.caches.get(read[0], shot.volumes[0].density)
                here = self.paths.shot(shot)
                return scene.make_scene(here, self.frame, volume, self.roots.reading, warn)
        finally:
            self._same(read)

    def _same(self, read: list[Cache]) -> None:
        now = scene.files_of(self.job.shot, self.frame, self.paths)
        for file in set(read) - set(now):
            raise StaleError(f"{file.path}: changes while its frame is rendered")

    def _whole(self, files: FrameStore, part: Part, plan: Plan) -> core.Partial | None:
        """A partial that is there already, from an attempt whose completion was not heard."""
        try:
            return self._read(files, part, plan) if files.part(part).exists() else None
        except core.InputError:
            return None

    def _read(self, files: FrameStore, part: Part, plan: Plan) -> core.Partial:
        """A partial of this very frame; a damaged or foreign one is removed, to be made again."""
        path = files.part(part)
        try:
            partial = core.Partial.read(str(path))
            if partial.identity != plan.identity:
                raise core.InputError(f"{path}: is of another frame or shot")
        except core.InputError:
            if (holds := files.plan()) is None or holds.identity != plan.identity:
                raise StaleError(f"frame {self.frame}: has been planned anew") from None
            path.unlink(missing_ok=True)
            raise
        return partial

    def _samples(
        self, view: core.Scene, plan: Plan, bucket: Bucket, samples: tuple[int, int]
    ) -> core.Partial:
        with self._phase("render"):
            sampler = Sampler(
                view,
                self.job.shot,
                plan.transport,
                frame=self.frame,
                threads=self.threads,
                control=self.control,
            )
            return sampler.parts([bucket], samples)[0]

    def _step(self) -> None:
        self.steps += 1

    @contextlib.contextmanager
    def _phase(self, name: str) -> Iterator[None]:
        """Adds the seconds of a block to a phase of the task."""
        self._step()
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.phases[name] = self.phases.get(name, 0.0) + time.perf_counter() - begun

    def _begin_next(self) -> None:
        """Begins to read the next frame's cache; if that cannot be, its own task will say so."""
        shot = self.job.shot
        later = [frame for frame in shot.frame_numbers if frame > self.frame]
        if later and scene.cache_path(self.paths.shot(shot), later[0]).exists():
            cache = scene.cache_of(shot, later[0], self.paths)
            self.caches.read_ahead(cache, shot.volumes[0].density)
