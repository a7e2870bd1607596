"""Frame ranges ("1-10,20-30x2") and the frame patterns of file names (####, %04d, $F4)."""

import re
from functools import lru_cache

MAX_FRAMES = 100_000

_RANGE = re.compile(r"(\d{1,9})(?:-(\d{1,9})(?:x(\d{1,9}))?)?")
_PATTERN = re.compile(r"#+|%(?:0?(\d{1,2}))?d|\$F(\d{1,2})?")


@lru_cache(64)
def parse_frames(text: str) -> tuple[int, ...]:
    """The frames of a range in rising order, each once."""
    frames: set[int] = set()
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        if match is None:
            raise ValueError(f"{part.strip()!r} is no frame range; write 7, 1-24, 1-24x2 or 1-3,8")
        first = int(match[1])
        last = int(match[2] or first)
        step = int(match[3] or 1)
        if last < first or step < 1:
            raise ValueError(f"{part.strip()!r} runs backwards or stands still; write first-lastxN")
        if (last - first) // step >= MAX_FRAMES:
            raise ValueError(f"{part.strip()!r} has over {MAX_FRAMES} frames; split the shot")
        frames.update(range(first, last + 1, step))
        if len(frames) > MAX_FRAMES:
            raise ValueError(f"over {MAX_FRAMES} frames; split the shot")
    return tuple(sorted(frames))


def has_pattern(path: str) -> bool:
    """Whether the path stands for a sequence."""
    return _PATTERN.search(path.rpartition("/")[2]) is not None


def expand(path: str, frame: int) -> str:
    """The path of one frame; one without a pattern is the same for all. The folders are as they
    are: whoever named one "take #3" meant no frame."""

    def number(match: re.Match[str]) -> str:
        width = len(match[0]) if match[0][0] == "#" else int(match[1] or match[2] or 0)
        return f"{frame:0{width}d}" if width else str(frame)

    folder, slash, name = path.rpartition("/")
    return folder + slash + _PATTERN.sub(number, name)
