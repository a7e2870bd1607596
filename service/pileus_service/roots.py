"""The folders that shots may read and write under; links are followed before the check."""

from collections.abc import Iterable
from pathlib import Path

from pileus_service.errors import InputError
from pileus_service.shot import Shot


class Roots:
    """An allow-list of folders."""

    def __init__(self, folders: Iterable[Path]) -> None:
        self.folders = [folder.resolve() for folder in folders]
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
                # Sequences share their folder: its links are followed once.
                if path.parent not in folders:
                    folders[path.parent] = path.parent.resolve()
                real = folders[path.parent] / path.name
                if path.name == ".." or real.is_symlink():
                    real = path.resolve()
                if not any(real.is_relative_to(root) for root in self.folders):
                    allowed = ", ".join(map(str, self.folders))
                    raise InputError(f"{field}: {path} lies outside the roots ({allowed})")
