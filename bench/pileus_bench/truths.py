"""The truth of a frame: `reference` until its own noise is small, kept by a content digest."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pileus_core as core

from pileus_bench.measures import Image, Truth
from pileus_bench.process import Spent

REFERENCE = {"transport": {"method": "reference", "max_bounces": None}}
PILOT = 16
MOST_SAMPLES = 1 << 18
SEEDS = (1_000_001, 1_000_002)

Render = Callable[[dict[str, Any], int, int], tuple[Image, Spent]]


def truth_of(
    view: dict[str, Any], render: Render, noise: float, most_seconds: float, data: Path
) -> tuple[Truth, int]:
    """The two halves and the samples of each. The renderer has loaded the view.

    The pilot says how many samples reach the noise (a relMSE); no more than fit in the
    core seconds.
    """
    file = data / "truths" / f"{digest(view, noise, most_seconds)}.npz"
    if file.is_file():
        held = np.load(file)
        return Truth(held["a"].astype(np.float64), held["b"].astype(np.float64)), int(
            held["samples"]
        )
    pilots = [render(REFERENCE, PILOT, seed) for seed in SEEDS]
    pilot = Truth(pilots[0][0], pilots[1][0])
    seconds = sum(spent.cpu_seconds for _, spent in pilots)
    wanted = PILOT * pilot.noise / noise
    samples = int(min(wanted, PILOT * most_seconds / seconds, MOST_SAMPLES))
    if samples > PILOT:
        a, b = (render(REFERENCE, samples, seed)[0] for seed in SEEDS)
        truth = Truth(a, b)
    else:
        truth, samples = pilot, PILOT
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(".part.npz")
    np.savez(
        part, a=truth.a.astype(np.float32), b=truth.b.astype(np.float32), samples=np.array(samples)
    )
    part.rename(file)
    return truth, samples


def digest(view: dict[str, Any], noise: float, most_seconds: float) -> str:
    """Of all that a truth depends on: the cache's bytes, the view, the renderer's version."""
    told = {
        "cache": hashlib.sha256(Path(view["cache"]).read_bytes()).hexdigest(),
        "version": core.__version__,
        "noise": noise,
        "most_seconds": most_seconds,
        **{key: view[key] for key in view if key not in ("shot", "frame", "cache", "voxels")},
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
