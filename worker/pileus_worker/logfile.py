"""Bounds the log files of the embedded farm, to which processes append for as long as it lives."""

import contextlib
import os
import shutil
from pathlib import Path

LOG_BYTES = 64 << 20


def keep_bounded(path: Path, most: int = LOG_BYTES) -> None:
    """Empties a log that has grown beyond a size, in bytes; its lines are kept once more beside it.

    In place, as those who append to it may hold it open.
    """
    with contextlib.suppress(OSError):  # on a full disk the farm matters more
        if path.stat().st_size > most:
            with contextlib.suppress(OSError):
                shutil.copyfile(path, path.with_suffix(".old.log"))
            os.truncate(path, 0)
