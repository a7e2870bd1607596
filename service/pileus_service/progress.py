"""Progress that tells the truth: bars for people, plain lines for a pipe; always on stderr."""

import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING, NamedTuple, Self

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

LINE_EVERY = 5.0


class Row(NamedTuple):
    """One bar: its name, the share that is done, and what to say beside it."""

    name: str
    fraction: float
    detail: str


def duration(seconds: float | None) -> str:
    """A time as people say it."""
    if seconds is None:
        return "-"
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


class Display:
    """Shows rows; the first is the whole, the others come and go."""

    def __init__(self) -> None:
        self._bars = _bars() if sys.stderr.isatty() else None
        self._tasks: dict[str, TaskID] = {}
        self._said = ""
        self._said_at = 0.0

    def __enter__(self) -> Self:
        if self._bars:
            self._bars.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bars:
            self._bars.stop()

    def show(self, *rows: Row) -> None:
        if self._bars is None:
            self._say(rows[0])
            return
        for gone in self._tasks.keys() - {row.name for row in rows}:
            self._bars.remove_task(self._tasks.pop(gone))
        for row in rows:
            if row.name not in self._tasks:
                self._tasks[row.name] = self._bars.add_task(row.name, total=1.0, detail="")
            self._bars.update(self._tasks[row.name], completed=row.fraction, detail=row.detail)

    def note(self, text: str) -> None:
        """A line that stays."""
        if self._bars:
            self._bars.console.print(text, highlight=False, markup=False, emoji=False)
        else:
            print(text, file=sys.stderr, flush=True)

    def _say(self, row: Row) -> None:
        line = f"{row.name}: {row.fraction:.0%}, {row.detail}"
        now = time.monotonic()
        if line != self._said and now - self._said_at >= LINE_EVERY:
            self._said, self._said_at = line, now
            print(line, file=sys.stderr, flush=True)


def _bars() -> "Progress":
    from rich.console import Console  # a pipe need not wait for it
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[detail]}", markup=False),
        console=Console(stderr=True),
        transient=True,
    )
