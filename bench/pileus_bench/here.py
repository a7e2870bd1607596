"""Pileus in this process, timed, with a scene loaded and its truth: for what needs no peers."""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pileus_bench.measures import Image, Truth
from pileus_bench.process import Spent
from pileus_bench.renderers.pileus import Pileus
from pileus_bench.scenes import (
    SHARED,
    AbsentError,
    cache_folder,
    load_scene,
    scene_names,
    view_of,
)
from pileus_bench.truths import truth_of

TRUTH_NOISE, TRUTH_SECONDS = 3e-4, 60.0


class Here(Pileus):
    def timed(self, settings: dict[str, Any], samples: int, seed: int) -> tuple[Image, Spent]:
        """As `RendererProcess.render`."""
        begun, begun_cpu = time.perf_counter(), time.process_time()
        image = self.render(settings, samples, seed)
        spent = Spent(
            seconds=time.perf_counter() - begun, cpu_seconds=time.process_time() - begun_cpu
        )
        return image.astype(np.float64), spent


def parser(description: str) -> argparse.ArgumentParser:
    """With the options that `ready` takes."""
    made = argparse.ArgumentParser(description=description)
    made.add_argument("--scenes", default=",".join(scene_names()))
    made.add_argument("--scale", type=float, default=0.5, help="of the picture's sides")
    made.add_argument("--data", type=Path, default=cache_folder(), help="keeps caches and truths")
    made.add_argument("--shared", type=Path, default=SHARED, help="real caches")
    return made


def ready(asked: argparse.Namespace) -> Iterator[tuple[str, Here, Truth]]:
    """Each scene's first frame, loaded; a line for one that cannot be shown here."""
    data = asked.data.resolve()
    for name in asked.scenes.split(","):
        try:
            scene = load_scene(name, asked.scale, data, asked.shared)
            view = view_of(scene, scene.frames[0], data)
        except AbsentError as absent:
            print(absent)
            continue
        renderer = Here()
        renderer.load(view)
        truth, _ = truth_of(view, renderer.timed, TRUTH_NOISE, TRUTH_SECONDS, data)
        yield name, renderer, truth
