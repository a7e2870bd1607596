"""What a renderer's process is asked and answers: a JSON object a line.

Needs only the standard library and numpy, for a peer may live in an environment of its own.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]


class Renderer(Protocol):
    """Renders one view at a time; what a view holds `scenes.view_of` says. One that stops by itself
    has `samples`, the mean over pixels of its last image."""

    about: str  # name, version and whatever decides its speed

    def load(self, view: dict[str, Any]) -> None:
        """Makes ready all that is the same for every render of the view, compiled and warm."""

    def render(self, settings: dict[str, Any], samples: int, seed: int) -> Image:
        """Linear Rec. 709 of shape (height, width, 3)."""


def serve(begin: Callable[[], Renderer]) -> None:
    """Answers requests until the asker goes. The first line tells what starting has cost."""
    # A renderer may print what it likes: only answers go where the asker listens.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def answer(told: dict[str, Any]) -> None:
        print(json.dumps(told), file=answers, flush=True)

    begun = time.perf_counter()
    try:
        renderer = begin()
    except Exception as error:
        answer({"error": f"{type(error).__name__}: {error}"})
        return
    answer({"seconds": time.perf_counter() - begun, "about": renderer.about})
    for line in sys.stdin:
        try:
            answer(_answer_to(json.loads(line), renderer))
        except Exception as error:
            answer({"error": f"{type(error).__name__}: {error}"})


def _answer_to(asked: dict[str, Any], renderer: Renderer) -> dict[str, Any]:
    if "view" in asked:
        return _timed(lambda: renderer.load(asked["view"]))
    images: list[Image] = []
    spent = _timed(
        lambda: images.append(renderer.render(asked["settings"], asked["samples"], asked["seed"]))
    )
    np.save(asked["out"], images[0])
    return spent | {"samples": getattr(renderer, "samples", asked["samples"])}


def _timed(work: Callable[[], None]) -> dict[str, float]:
    """Wall seconds, and the processor's for the whole process."""
    begun, begun_cpu = time.perf_counter(), time.process_time()
    work()
    return {
        "seconds": time.perf_counter() - begun,
        "cpu_seconds": time.process_time() - begun_cpu,
    }
