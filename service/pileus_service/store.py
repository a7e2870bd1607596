"""The farm's truth: a folder of jobs, their plans, partials and done markers.

Every file is written whole or not at all, so what is there can be trusted after any crash, and
Redis can be rebuilt from it. Layout: farm.json, jobs/ID/{job.json,state.json},
jobs/ID/frames/NNNNNN/{plan.json,preview.png,done.json,parts/BUCKET.SAMPLES.exr,logs/WORKER.jsonl}.
"""

import contextlib
import math
import os
import secrets
import shutil
from collections.abc import Container, Iterator
from functools import lru_cache
from pathlib import Path
from typing import TypeVar, cast

from pydantic import ValidationError

from pileus_service.jobs import JOB_ID, Cache, Done, FarmMark, Job, Look, Part, Plan, Record, Wish

FARM = "farm.json"
R = TypeVar("R", bound=Record)


def write_whole(path: Path, data: bytes, *, once: bool = False) -> bool:
    """Writes through a temporary file; with `once`, the first writer wins (else returns False)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}")
    try:
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if once:
            os.link(temporary, path)
        else:
            temporary.replace(path)
    except FileExistsError:
        return False
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)
    return True


def sync_folder(folder: Path) -> None:
    """Makes the renames in a folder last through a power cut."""
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def sweep(folder: Path, before: float = math.inf) -> None:
    """Removes what killed writers left in a folder, unless it was touched after a time: then its
    writer may be at work. What cannot be removed stays, as what NFS keeps of an open file."""
    for left in folder.glob(".*"):
        with contextlib.suppress(OSError):
            if left.lstat().st_mtime >= before:
                continue
            if left.is_dir():
                shutil.rmtree(left)
            else:
                left.unlink()


class FrameStore:
    """The files of one frame of a job."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.preview = folder / "preview.png"
        self.logs = folder / "logs"

    def part(self, part: Part) -> Path:
        return self.folder / "parts" / part.name

    def parts(self) -> set[str]:
        """The names of the partials that are there: one look, where a look for each would be ten
        thousand questions to a file server."""
        try:
            return {path.name for path in (self.folder / "parts").iterdir()}
        except FileNotFoundError:
            return set()

    def look_again(self) -> None:
        for folder in (self.folder, self.folder / "parts"):
            with contextlib.suppress(FileNotFoundError):
                _look_again(folder)

    def plan(self) -> Plan | None:
        return _read(self.folder / "plan.json", Plan)

    def keep_plan(self, plan: Plan) -> Plan:
        """Keeps the first plan that is made; returns the one that holds."""
        path, data = self.folder / "plan.json", plan.model_dump_json().encode()
        if not write_whole(path, data, once=True) and self.plan() is None:
            write_whole(path, data)  # a damaged one is made anew
        return self.plan() or plan

    def drop_plan(self) -> None:
        """Forgets plan and partials, where the cache has changed under them."""
        (self.folder / "plan.json").unlink(missing_ok=True)
        self.drop_parts()

    def seen(self) -> list[Cache]:
        """The caches as the last look found them, where a frame waits for them."""
        look = _read(self.folder / "seen.json", Look)
        return look.caches if look else []

    def mark_seen(self, caches: list[Cache]) -> float:
        """Keeps what a look found; returns when that was, by the file server's clock."""
        path = self.folder / "seen.json"
        write_whole(path, Look(caches=caches).model_dump_json().encode())
        return path.stat().st_mtime

    def done(self) -> Done | None:
        return _read(self.folder / "done.json", Done)

    def mark_done(self, done: Done) -> None:
        write_whole(self.folder / "done.json", done.model_dump_json().encode())

    def drop_parts(self) -> None:
        shutil.rmtree(self.folder / "parts", ignore_errors=True)

    def sweep(self) -> None:
        """Removes the partials, and what was being written here when its writer was killed."""
        self.drop_parts()
        sweep(self.folder)


def _look_again(folder: Path) -> None:
    """Has an NFS client ask which names there are: it may remember one as absent that another
    host has made since, and asks anew when a folder is opened (close-to-open consistency)."""
    os.close(os.open(folder, os.O_RDONLY | os.O_DIRECTORY))


def farm_of(root: Path) -> str | None:
    """The id of the farm whose data folder this is, if any."""
    mark = _read(root / FARM, FarmMark)
    return mark.id if mark else None


class Store:
    """The data folder, shared by the service and all workers."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.jobs_folder = root / "jobs"
        self.jobs_folder.mkdir(parents=True, exist_ok=True)

    def begin(self) -> str:
        """The farm's id, made by the first service that begins a farm here."""
        if (held := self.farm()) is not None:
            return held
        path, mark = self.root / FARM, FarmMark(id=secrets.token_hex(8))
        # What is there, and still holds no id, is damaged: others who begin write it whole, once.
        if path.exists() and self.farm() is None:
            path.unlink(missing_ok=True)
        write_whole(path, mark.model_dump_json().encode(), once=True)
        return self.farm() or mark.id

    def farm(self) -> str | None:
        """The farm's id; None where no farm has begun, as in a folder that is not mounted."""
        return farm_of(self.root)

    def create(self, job: Job, wish: Wish) -> bool:
        """Keeps a new job; False where one of its id is there already."""
        folder = self._folder(job.id)
        # Of several who make it at once, the wish of the first holds.
        write_whole(folder / "state.json", wish.model_dump_json().encode(), once=True)
        return write_whole(folder / "job.json", job.model_dump_json().encode(), once=True)

    def job(self, job_id: str) -> Job | None:
        return _read(self._folder(job_id) / "job.json", Job)

    def has(self, job_id: str) -> bool:
        return (self._folder(job_id) / "job.json").exists()

    def removed(self, job_id: str) -> bool:
        """Whether a job is not here, nor was just made by another host."""
        _look_again(self.jobs_folder)
        return not self.has(job_id)

    def job_ids(self, known: Container[str] = ()) -> Iterator[str]:
        """The jobs that are here; a folder of a known one is believed to hold it."""
        return (name for name in self.folders() if name in known or self.has(name))

    def folders(self) -> Iterator[str]:
        """The names of the jobs' folders, those included that hold no whole job."""
        with os.scandir(self.jobs_folder) as folders:
            for folder in folders:
                if JOB_ID.fullmatch(folder.name):
                    yield folder.name

    def wish(self, job_id: str, wish: Wish) -> None:
        write_whole(self._folder(job_id) / "state.json", wish.model_dump_json().encode())

    def wished(self, job_id: str) -> Wish:
        return _read(self._folder(job_id) / "state.json", Wish) or Wish()

    def frame(self, job_id: str, frame: int) -> FrameStore:
        return FrameStore(self._folder(job_id) / "frames" / f"{frame:06d}")

    def done_frames(self, job: Job) -> list[int]:
        """The indices of the frames whose done marker is there."""
        marks = {path.parent.name for path in self._folder(job.id).glob("frames/*/done.json")}
        return [i for i, n in enumerate(job.shot.frame_numbers) if f"{n:06d}" in marks]

    def forget(self, job_id: str) -> Path:
        """Forgets a job at once, as one of the same id may be made while its files go; they are in
        the folder that is returned. Its images, which lie outside, stay."""
        folder = self._folder(job_id)
        gone = folder.with_name(f".{job_id}.{secrets.token_hex(4)}")
        with contextlib.suppress(FileNotFoundError):
            folder.rename(gone)
        return gone

    def sweep(self, before: float) -> None:
        """Removes what killed writers left here, beside the jobs."""
        for name in ("jobs", "outbox", "tokens"):
            sweep(self.root / name, before)

    def sweep_job(self, job_id: str, before: float) -> None:
        """Removes what killed writers left of a job; all of it where its making was cut short."""
        folder = self._folder(job_id)
        with contextlib.suppress(OSError):
            if self.has(job_id) or folder.stat().st_mtime >= before:
                sweep(folder, before)
            else:
                shutil.rmtree(folder)

    def _folder(self, job_id: str) -> Path:
        if not JOB_ID.fullmatch(job_id):
            raise ValueError(f"{job_id!r} is no job id")
        return self.jobs_folder / job_id


def _read(path: Path, kind: type[R]) -> R | None:
    """The record of a file; a damaged one counts as absent, so that it is made again."""
    try:
        found = path.stat()
        record = _parsed(path, found.st_ino, found.st_mtime_ns, found.st_size, kind)
    except (FileNotFoundError, NotADirectoryError, ValidationError):
        return None
    return cast(R, record)


@lru_cache(32)
def _parsed(path: Path, inode: int, mtime_ns: int, size: int, kind: type[Record]) -> Record:
    """Parses a file once: as each is written whole, another inode or time is another record."""
    return kind.model_validate_json(path.read_bytes())
