"""The folders that shots may read and write under.

Links are followed before a path is checked, and none is followed when it is opened: what a
location of `reading` or `writing` leads to is what was checked, whatever its path has come to mean
since (openat with O_PATH and O_NOFOLLOW step by step, then /proc/self/fd, see proc_pid_fd(5)).
"""

import contextlib
import errno
import os
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path

from pileus_service.errors import FarmError, InputError
from pileus_service.shot import Shot

_STEP = os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
# Opens nothing: a FIFO would wait for a writer, and a device may act.
_LOOK = os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC
# What keeps a folder from being made that no other shot would change.
_DISK = {errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ESTALE}


class Roots:
    """An allow-list of folders; the farm's own folder is none of theirs, wherever it lies."""

    def __init__(self, folders: Iterable[Path], barred: Path | None = None) -> None:
        self.folders = [folder.resolve() for folder in folders]
        self._barred = barred.resolve() if barred else None
        if not self.folders:
            raise InputError("no root: give at least one --root folder")

    @property
    def first(self) -> Path:
        """Where relative paths of a shot without a file begin."""
        return self.folders[0]

    def check(self, shot: Shot, frames: Iterable[int]) -> None:
        """Refuses a shot any of whose files lies outside; its paths must be absolute."""
        folders: dict[Path, Path] = {}
        for frame in frames:
            for field, path in (*shot.inputs(frame), ("image.output", shot.output(frame))):
                try:
                    # Sequences share their folder: its links are followed once.
                    if path.parent not in folders:
                        folders[path.parent] = path.parent.resolve()
                    real = folders[path.parent] / path.name
                    if path.name == ".." or real.is_symlink():
                        real = path.resolve()
                    self._root_of(path, real)
                except InputError as error:
                    raise InputError(f"{field}: {error}") from None
                except (OSError, RuntimeError) as error:
                    raise InputError(f"{field}: {_reason(error)}: {path}; mend the path") from None

    @contextlib.contextmanager
    def reading(self, path: Path) -> Iterator[str]:
        """A location at which to read a file of a root. Refuses what is no regular file."""
        with contextlib.ExitStack() as held:
            with _refusals(path):
                real = path.resolve()
                folder = self._folder(path, real.parent, held)
                file = os.open(real.name, _LOOK, dir_fd=folder)
            held.callback(os.close, file)
            if not stat.S_ISREG(os.fstat(file).st_mode):
                raise InputError(f"{path}: is no regular file")
            held.enter_context(_named(path, location := f"/proc/self/fd/{file}"))
            yield location

    @contextlib.contextmanager
    def writing(self, path: Path) -> Iterator[str]:
        """A location at which to write a file of a root, its folders made. A link that has the
        file's own name is to be replaced, not followed."""
        with contextlib.ExitStack() as held:
            with _refusals(path), _disk_troubles(path):
                folder = self._folder(path, path.parent.resolve(), held, make=True)
            location = f"/proc/self/fd/{folder}/{path.name}"
            held.enter_context(_named(path, location))
            yield location

    def _root_of(self, path: Path, real: Path) -> Path:
        if self._barred and real.is_relative_to(self._barred):
            raise InputError(f"{path} lies in the farm's own folder; choose another place")
        for root in self.folders:
            if real.is_relative_to(root):
                return root
        allowed = ", ".join(map(str, self.folders))
        raise InputError(f"{path} lies outside the roots ({allowed})")

    def _folder(
        self, path: Path, real: Path, held: contextlib.ExitStack, make: bool = False
    ) -> int:
        """A folder that no link leads to, whatever happens to its path meanwhile."""
        root = self._root_of(path, real)
        folder = os.open(root, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
        held.callback(os.close, folder)
        for name in real.relative_to(root).parts:
            if make:
                with contextlib.suppress(FileExistsError):
                    os.mkdir(name, dir_fd=folder)
            folder = os.open(name, _STEP, dir_fd=folder)
            held.callback(os.close, folder)
        return folder


@contextlib.contextmanager
def _refusals(path: Path) -> Iterator[None]:
    """A file that cannot be opened, or has become something else, is one line."""
    try:
        yield
    except FarmError:
        raise
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: {_reason(error)}") from None


@contextlib.contextmanager
def _disk_troubles(path: Path) -> Iterator[None]:
    """A disk that is full or read-only is no wrong input."""
    try:
        yield
    except OSError as error:
        if error.errno not in _DISK:
            raise
        raise FarmError(f"{path}: {_reason(error)}") from None


@contextlib.contextmanager
def _named(path: Path, location: str) -> Iterator[None]:
    """Errors of what is done at the location tell the path instead."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        if location not in str(error):
            raise
        raise type(error)(str(error).replace(location, str(path))) from None


def _reason(error: OSError | RuntimeError) -> str:
    return (getattr(error, "strerror", None) or "runs in a circle of links").lower()
