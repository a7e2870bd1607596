"""What each attempt at a frame had to say, kept beside the frame.

Every worker appends to a file of its own, as appending by several hosts to one file is not safe on
NFS. A file that has grown to its bound becomes the worker's old one, and the older is dropped.
"""

import contextlib
import logging
import os
from pathlib import Path

import structlog
from pydantic import BaseModel, ValidationError

from pileus_service.logs import json_formatter
from pileus_service.store import Store

FILE_BYTES = 128 << 10
FILES_READ = 64


class LogLine(BaseModel):
    """One event of an attempt; `output` is what the render process itself wrote."""

    time: str
    level: str
    event: str
    worker: str = ""
    task: str = ""
    attempt: int | None = None
    seconds: float | None = None
    cause: str | None = None
    reason: str | None = None
    output: str | None = None


class FrameLog(logging.Handler):
    """Keeps the lines that are about a frame with that frame."""

    def __init__(self, store: Store) -> None:
        super().__init__()
        self._store = store
        self.setFormatter(json_formatter())

    def emit(self, record: logging.LogRecord) -> None:
        about = structlog.contextvars.get_contextvars()
        if not {"job", "frame", "worker"} <= about.keys():
            return
        try:
            if not self._store.has(about["job"]):
                return
            folder = self._store.frame(about["job"], about["frame"]).logs
            _append(folder / f"{about['worker']}.jsonl", self.format(record))
        except OSError:
            # The worker's own log has the line; a disk that fails must not end the worker.
            return


def _append(path: Path, line: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        os.write(file, line.encode() + b"\n")
        full = os.fstat(file).st_size > FILE_BYTES
    finally:
        os.close(file)
    if full:
        path.replace(path.with_suffix(".old.jsonl"))


def read(folder: Path, limit: int) -> list[LogLine]:
    """The last lines of all workers in the order of their time."""
    files = []
    for path in folder.glob("*.jsonl"):
        with contextlib.suppress(FileNotFoundError):  # it is an old one by now, or gone
            files.append((path.stat().st_mtime, path))
    lines = []
    for _, path in sorted(files)[-FILES_READ:]:
        with contextlib.suppress(FileNotFoundError):
            for text in path.read_bytes().splitlines():
                # Half a line is of a host that went down.
                with contextlib.suppress(ValidationError):
                    lines.append(LogLine.model_validate_json(text))
    return sorted(lines, key=lambda line: line.time)[-limit:]
