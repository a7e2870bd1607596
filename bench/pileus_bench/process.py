"""A renderer in a process of its own, asked by `renderers.protocol`."""

import contextlib
import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from pileus_service.errors import FarmError

Image = NDArray[np.float64]


class RendererError(FarmError):
    """The renderer cannot be had, has refused or has died; one line says why."""


class Spent(BaseModel):
    """Wall seconds, and the processor's over all threads of the process; and the samples a pixel,
    where they are not those that were asked for."""

    seconds: float
    cpu_seconds: float
    samples: float | None = None


class RendererProcess:
    """Starts the module with an interpreter; `start_seconds` is what that took."""

    def __init__(self, module: str, python: str) -> None:
        self._module = module
        self._folder = tempfile.TemporaryDirectory()
        self._errors = (Path(self._folder.name) / "stderr").open("w+")
        here = Path(__file__).resolve().parent.parent
        self._process = subprocess.Popen(
            [python, "-m", f"pileus_bench.renderers.{module}"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env={**os.environ, "PYTHONPATH": str(here)},
        )
        try:
            told = self._answer()
        except RendererError:
            self.close()
            raise
        self.start_seconds = float(told["seconds"])
        self.about = str(told["about"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Lets the process end, or ends it."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._errors.close()
        self._folder.cleanup()

    def load(self, view: dict[str, Any]) -> Spent:
        return Spent.model_validate(self._ask({"view": view}))

    def render(self, settings: dict[str, Any], samples: int, seed: int) -> tuple[Image, Spent]:
        """The image of shape (height, width, 3), and wall and CPU seconds of the process."""
        out = Path(self._folder.name) / "image.npy"
        asked = {"settings": settings, "samples": samples, "seed": seed, "out": str(out)}
        spent = Spent.model_validate(self._ask(asked))
        return np.load(out).astype(np.float64), spent

    def _ask(self, asked: dict[str, Any]) -> dict[str, Any]:
        assert self._process.stdin is not None
        try:
            print(json.dumps(asked), file=self._process.stdin, flush=True)
        except BrokenPipeError:
            raise RendererError(self._last_words()) from None
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RendererError(self._last_words())
        told: dict[str, Any] = json.loads(line)
        if "error" in told:
            raise RendererError(f"{self._module}: {told['error']}")
        return told

    def _last_words(self) -> str:
        code = self._process.wait()
        self._errors.seek(0)
        lines = self._errors.read().strip().splitlines()
        return f"{self._module}: ended with code {code}{': ' + lines[-1] if lines else ''}"
