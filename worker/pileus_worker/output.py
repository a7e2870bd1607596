"""What the render process prints, read as it comes: the last of it is kept with each attempt."""

import multiprocessing
import os

KEPT = 16 << 10


class Output:
    """A pipe that outlives the children that write to it, so that a dead one's last words are read.

    It is read without waiting; `drain` must be called often, or a child that prints much waits.
    """

    def __init__(self) -> None:
        self._reading, self.writing = multiprocessing.Pipe(duplex=False)
        os.set_blocking(self._reading.fileno(), False)
        self._held = b""

    def drain(self) -> None:
        """Takes what has come, and keeps the end of it."""
        try:
            while data := os.read(self._reading.fileno(), 1 << 16):
                self._held = (self._held + data)[-KEPT:]
        except BlockingIOError:
            return

    def take(self) -> str:
        """What was printed since the last time."""
        self.drain()
        text, self._held = self._held.decode(errors="replace").strip(), b""
        return text
