"""What a render child does: plans a frame, renders a part of one, merges one."""

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pileus_core as core

from pileus_service.errors import InputError
from pileus_service.jobs import (
    Bucket,
    Cache,
    Done,
    Job,
    Kind,
    Merged,
    Plan,
    Planned,
    Rendered,
    Replan,
    Result,
)
from pileus_service.roots import Roots
from pileus_service.store import FrameStore, Store
from pileus_worker import planning, scene
from pileus_worker.caches import Caches
from pileus_worker.paths import PathMap
from pileus_worker.pictures import write_preview


@dataclass
class Work:
    """One task, with all it needs to be done in."""

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
    control: core.Control = field(default_factory=core.Control)
    phases: dict[str, float] = field(default_factory=dict)

    def run(self) -> Result:
        self.roots.check(self.paths.shot(self.job.shot), [self.frame])
        files = self.store.frame(self.job.id, self.frame)
        files.look_again()
        if self.kind is Kind.PLAN:
            return self._plan(files)
        plan = files.plan()
        if plan is None:
            raise InputError(f"frame {self.frame}: its plan is gone from the data folder")
        if plan.identity != scene.identity(self.job.shot, self.frame, plan.cache):
            return Replan()
        if self.kind is Kind.RENDER:
            return self._render(files, plan)
        return self._merge(files, plan)

    def _plan(self, files: FrameStore) -> Planned:
        """Makes the frame's plan, or takes up one that is there, with what it has finished."""
        cache = scene.cache_of(self.job.shot, self.frame, self.paths)
        identity = scene.identity(self.job.shot, self.frame, cache)
        plan = files.plan()
        if plan is not None and plan.identity != identity:
            files.drop_plan()
            plan = None
        plan = plan or files.keep_plan(self._new_plan(cache, identity))
        finished = [i for i, part in enumerate(plan.parts) if files.part(part).exists()]
        return Planned(
            tasks=len(plan.parts),
            finished=finished,
            total=sum(part.pixel_samples for part in plan.parts),
            samples=sum(plan.parts[i].pixel_samples for i in finished),
        )

    def _new_plan(self, cache: Cache, identity: str) -> Plan:
        begun = time.time()
        shot = self.job.shot
        view, transport = self._scene(cache), scene.make_transport(shot)
        size = (shot.image.width, shot.image.height)
        with self._phase("plan"):
            cost = planning.measure(
                view,
                transport,
                size,
                seed=shot.sampling.seed,
                frame=self.frame,
                threads=self.threads,
                control=self.control,
            )
        parts, empty = planning.cut(view, cost, size, shot.sampling.samples, self.task_seconds)
        return Plan(
            frame=self.frame,
            identity=identity,
            cache=cache,
            parts=parts,
            empty=empty,
            begun=begun,
        )

    def _render(self, files: FrameStore, plan: Plan) -> Rendered:
        part = plan.parts[self.part]
        path = files.part(part)
        if not _whole(path, plan.identity):
            view = self._scene(plan.cache)
            self._read_ahead()
            path.parent.mkdir(parents=True, exist_ok=True)
            partial = self._samples(view, part.bucket, part.samples)
            with self._phase("write"):
                partial.write(str(path), plan.identity)
        return Rendered(samples=part.pixel_samples)

    def _merge(self, files: FrameStore, plan: Plan) -> Merged:
        """Writes the image from the partials; those missing or damaged are to be made again."""
        if files.done() is not None:
            return Merged()
        shot = self.job.shot
        samples = shot.sampling.samples
        buckets = [*dict.fromkeys(part.bucket for part in plan.parts), *plan.empty]
        frame = core.Frame(
            shot.image.width, shot.image.height, [(bucket, samples) for bucket in buckets]
        )
        redo, trouble = [], ""
        with self._phase("merge"):
            for index, part in enumerate(plan.parts):
                try:
                    partial = _read(files.part(part), plan.identity)
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
        with self._phase("write"):
            self._write(files, frame, time.time() - plan.begun)
        return Merged()

    def _empty_buckets(self, plan: Plan) -> Iterator[core.Partial]:
        if plan.empty:
            view = self._scene(plan.cache)
            for bucket in plan.empty:
                yield self._samples(view, bucket, (0, self.job.shot.sampling.samples))

    def _write(self, files: FrameStore, frame: core.Frame, seconds: float) -> None:
        shot = self.job.shot
        transport = scene.make_transport(shot)
        with self.roots.writing(self.paths.shot(shot).output(self.frame)) as location:
            frame.write(
                location,
                half=shot.image.pixel_type == "half",
                header=scene.header(shot, self.frame, transport, seconds),
            )
        write_preview(files.preview, frame.pixels(shot.transport.looks[0].name))
        files.mark_done(
            Done(
                frame=self.frame,
                file=str(shot.output(self.frame)),
                seconds=seconds,
                samples=shot.sampling.samples,
                method=shot.transport.method,
                max_bounces=transport.max_bounces,
                reason=scene.reason(shot),
            )
        )
        files.drop_parts()

    def _scene(self, cache: Cache) -> core.Scene:
        now = scene.cache_of(self.job.shot, self.frame, self.paths)
        if now != cache:
            raise InputError(f"{cache.path}: has changed since its frame was planned; submit again")
        with self._phase("load"):
            volume = self.caches.get(cache, self.job.shot.volumes[0].density)
        shot = self.paths.shot(self.job.shot)
        return scene.make_scene(shot, self.frame, volume, self.roots.reading)

    def _samples(self, view: core.Scene, bucket: Bucket, samples: tuple[int, int]) -> core.Partial:
        shot = self.job.shot
        with self._phase("render"):
            return core.render(
                view,
                scene.make_transport(shot),
                bucket=bucket,
                samples=samples,
                seed=shot.sampling.seed,
                frame=self.frame,
                orders=shot.image.orders,
                threads=self.threads,
                control=self.control,
            )

    @contextlib.contextmanager
    def _phase(self, name: str) -> Iterator[None]:
        """Adds the seconds of a block to a phase of the task."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.phases[name] = self.phases.get(name, 0.0) + time.perf_counter() - begun

    def _read_ahead(self) -> None:
        """Begins to read the next frame's cache; if that cannot be, its own task will say so."""
        shot = self.job.shot
        later = [frame for frame in shot.frame_numbers if frame > self.frame]
        if later and scene.cache_path(self.paths.shot(shot), later[0]).exists():
            cache = scene.cache_of(shot, later[0], self.paths)
            self.caches.read_ahead(cache, shot.volumes[0].density)


def _whole(path: Path, identity: str) -> bool:
    """Whether a partial is there already, from an attempt whose completion was not heard."""
    if not path.exists():
        return False
    try:
        _read(path, identity)
    except core.InputError:
        return False
    return True


def _read(path: Path, identity: str) -> core.Partial:
    """A partial of this very frame; a damaged or foreign one is removed, to be made again."""
    try:
        partial = core.Partial.read(str(path))
        if partial.identity != identity:
            raise core.InputError(f"{path}: is of another frame or shot")
    except core.InputError:
        path.unlink(missing_ok=True)
        raise
    return partial
