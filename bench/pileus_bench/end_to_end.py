"""From a cache on disk to a denoised image on disk: what a user waits for, as a whole.

Ours is the command `pileus render`, its start included; the peer's is reading and rendering, its
start apart. Samples double until the image is close enough to the truth.
"""

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pileus_core as core

from pileus_bench.bars import geometric_mean
from pileus_bench.contenders import CYCLES_DENOISED
from pileus_bench.measures import Image, Truth, trimmed_error
from pileus_bench.process import RendererError, RendererProcess, Spent
from pileus_bench.results import Bar, EndToEnd
from pileus_bench.scenes import AbsentError, BenchScene, load_scene, view_of
from pileus_bench.truths import truth_of

SCENES = ("cumulus", "smoke", "steam")
WIDTH, HEIGHT = 960, 540
TARGET = 1e-3
MOST_SAMPLES = 64
# A truth may be noisy here: over so many pixels its two halves still tell an error of 1e-3.
TRUTH_NOISE, TRUTH_SECONDS = 0.02, 60.0

Attempt = Callable[[int], tuple[Image, Spent]]


def end_to_end(renderer: RendererProcess, python: str, data: Path, shared: Path) -> list[EndToEnd]:
    """By scene, ours and the peer's at the first power of two that meets the target.

    `renderer` is Pileus, for the truths; `python` has the peer.
    """
    found = []
    for name in SCENES:
        try:
            scene = load_scene(name, 1.0, data, shared)
        except AbsentError:
            continue
        image = scene.shot.image.model_copy(update={"width": WIDTH, "height": HEIGHT})
        scene = replace(scene, shot=scene.shot.model_copy(update={"image": image}))
        view = view_of(scene, scene.frames[0], data)
        renderer.load(view)
        truth, _ = truth_of(view, renderer.render, TRUTH_NOISE, TRUTH_SECONDS, data)

        def theirs(samples: int, view: dict[str, object] = view) -> tuple[Image, Spent]:
            with RendererProcess(CYCLES_DENOISED.renderer, python) as process:
                load = process.load(view)
                image, spent = process.render(CYCLES_DENOISED.settings, samples, 1)
            return image, _sum(load, spent)

        def ours(samples: int, scene: BenchScene = scene) -> tuple[Image, Spent]:
            return _command(scene, samples)

        found.append(_search(name, "auto + OIDN", truth, ours))
        found.append(_search(name, CYCLES_DENOISED.name, truth, theirs))
    return found


def denoised_bar(found: list[EndToEnd]) -> Bar:
    """The peer's core seconds over ours, where both meet the target."""
    by_scene: dict[str, list[EndToEnd]] = {}
    for each in found:
        by_scene.setdefault(each.scene, []).append(each)
    ratios = {
        scene: theirs.cpu_seconds / ours.cpu_seconds
        for scene, (ours, theirs) in by_scene.items()
        if max(ours.rel_mse, theirs.rel_mse) <= TARGET
    }
    return Bar(
        what=f"denoised to relMSE {TARGET:g}, cache on disk to image on disk, core seconds of "
        "Cycles + OIDN over ours",
        wanted="10",
        values=ratios,
        mean=geometric_mean(ratios.values()),
    )


def _search(scene: str, contender: str, truth: Truth, attempt: Attempt) -> EndToEnd:
    """The first count of samples that meets the target, or the last that was tried."""
    samples = 1
    while True:
        image, spent = attempt(samples)
        error = trimmed_error(image, truth)
        if error <= TARGET or samples >= MOST_SAMPLES:
            return EndToEnd(
                scene=scene,
                contender=contender,
                samples=samples,
                rel_mse=error,
                seconds=spent.seconds,
                cpu_seconds=spent.cpu_seconds,
            )
        samples *= 2


def _command(scene: BenchScene, samples: int) -> tuple[Image, Spent]:
    """`pileus render` of the scene's first frame, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "shot.json"
        file.write_text(scene.shot.model_dump_json())
        sets = {
            "frames": str(scene.frames[0]),
            "image.output": f"{folder}/image.exr",
            "image.denoise": "true",
            "transport.method": "auto",
            "sampling.samples": str(samples),
            # For what the model may leave out: the noise is the filter's.
            "sampling.tolerance": str(TARGET**0.5),
        }
        command = [str(Path(sys.executable).with_name("pileus")), "render", str(file)]
        for key, value in sets.items():
            command += ["--set", f"{key}={value}"]
        begun, begun_cpu = time.perf_counter(), _children_seconds()
        ended = subprocess.run(command, capture_output=True, text=True)
        spent = Spent(
            seconds=time.perf_counter() - begun, cpu_seconds=_children_seconds() - begun_cpu
        )
        if ended.returncode != 0:
            raise RendererError(ended.stderr.strip().splitlines()[-1])
        (part,) = core.read_image(f"{folder}/image.exr").values()
    return np.stack([part[channel] for channel in "RGB"], axis=-1).astype(np.float64), spent


def _children_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _sum(a: Spent, b: Spent) -> Spent:
    return Spent(seconds=a.seconds + b.seconds, cpu_seconds=a.cpu_seconds + b.cpu_seconds)
