"""Where this machine keeps what a shot names, if its mounts differ from the service's."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import PurePath
from typing import Self

from pileus_service.errors import InputError
from pileus_service.shot import Shot


@dataclass(frozen=True)
class PathMap:
    """Folders of the farm and where they are here; the longest that holds a path counts."""

    pairs: tuple[tuple[PurePath, PurePath], ...] = ()

    @classmethod
    def parse(cls, texts: Iterable[str]) -> Self:
        """From FROM=TO words, both absolute folders."""
        pairs: dict[PurePath, PurePath] = {}
        for text in texts:
            farm, _, here = text.partition("=")
            if not PurePath(farm).is_absolute() or not PurePath(here).is_absolute():
                raise InputError(f"--map {text}: write FROM=TO, two absolute folders")
            if PurePath(farm) in pairs:
                raise InputError(f"--map {text}: {farm} is mapped already; give it once")
            pairs[PurePath(farm)] = PurePath(here)
        return cls(tuple(sorted(pairs.items(), key=lambda pair: -len(pair[0].parts))))

    def here(self, path: str) -> str:
        """A path of the farm's on this machine."""
        for farm, here in self.pairs:
            if PurePath(path).is_relative_to(farm):
                return str(here / PurePath(path).relative_to(farm))
        return path

    def shot(self, shot: Shot) -> Shot:
        """The shot with every file where this machine has it."""
        return shot.with_paths(self.here)


NOWHERE_ELSE = PathMap()
