"""Measures the denoiser on a shot's frames: its error by quality and by guide, and its flicker.

    python bench/denoising.py SHOT [--set KEY=VALUE] [--samples 1,4,16] [--repeats N] [--truth N]
        [--guides] [--still]

The truth of a frame is two independent halves A and B by the shot's own method. The mean of
(x - A)(x - B) is then the squared error without the truth's noise, and that of the same product of
frame-to-frame changes is the squared flicker: the change that the truth does not share. All are
relative as relMSE is, (r^2 + 0.01) below the line.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pileus_core as core
from numpy.typing import NDArray

from pileus_service.shot import Shot
from pileus_service.shotfile import load_shot
from pileus_worker import deciding, machine, scene
from pileus_worker.denoising import Filter, Pixels, Quality, guide_of, quality_of

Stack = NDArray[np.float64]  # (frames, height, width, 3)
OWN_GUIDE = "mid-grey to white"
TRUTH_SEEDS = (1_000_001, 1_000_002)


class Frames:
    """A shot's frames with their caches in memory."""

    def __init__(self, shot: Shot) -> None:
        self._shot = shot
        volumes = {
            frame: core.Volume(str(scene.cache_path(shot, frame)), shot.volumes[0].density)
            for frame in shot.frame_numbers
        }
        self._scenes = {
            frame: scene.make_scene(shot, frame, volume) for frame, volume in volumes.items()
        }
        first = shot.frame_numbers[0]
        resolved = deciding.resolve(
            shot, first, lambda: volumes[first], threads=0, control=core.Control()
        )
        self._transport = scene.make_transport(shot, resolved)

    def render(self, samples: int, seed: int, moving: bool = True) -> list[Pixels]:
        """RGBA of each frame; where it is not `moving`, all frames have the noise of the first."""
        size = (self._shot.image.width, self._shot.image.height)
        images = []
        for frame, view in self._scenes.items():
            whole = core.Frame(*size, [((0, 0, *size), samples)])
            whole.add(
                core.render(
                    view,
                    self._transport,
                    bucket=(0, 0, *size),
                    samples=(0, samples),
                    seed=seed,
                    frame=frame if moving else self._shot.frame_numbers[0],
                )
            )
            images.append(whole.pixels(self._shot.transport.looks[0].name))
        return images


def guides(filter_: Filter) -> dict[str, Callable[[Pixels], Pixels | None]]:
    """What may stand for an albedo, by name, each made of an RGBA image."""

    def grey(values: Pixels) -> Pixels:
        return np.repeat(np.asarray(values, np.float32)[..., np.newaxis], 3, axis=-1)

    return {
        "none": lambda image: None,
        "white": lambda image: grey(np.ones_like(image[..., 3])),
        "opacity": lambda image: grey(image[..., 3]),
        "prefiltered opacity": lambda image: filter_({"albedo": grey(image[..., 3])}, "HIGH"),
        OWN_GUIDE: lambda image: guide_of(image[..., 3]),
    }


def filters(
    filter_: Filter, quality: Quality, every_guide: bool
) -> dict[str, Callable[[Pixels], Pixels]]:
    """What is measured, by name: each quality with Pileus's own guide, and where they are asked
    for the other guides too, with the one that Pileus takes."""
    makers = guides(filter_)
    asked: list[tuple[str, Quality]] = [(OWN_GUIDE, each) for each in get_args(Quality)]
    if every_guide:
        asked += [(guide, quality) for guide in makers if guide != OWN_GUIDE]

    def one(guide: str, quality: Quality) -> Callable[[Pixels], Pixels]:
        def run(image: Pixels) -> Pixels:
            made = makers[guide](image)
            return filter_({"color": image} | ({} if made is None else {"albedo": made}), quality)

        return run

    return {f"{guide} | {quality}": one(guide, quality) for guide, quality in asked}


def stack(images: list[Pixels]) -> Stack:
    return np.stack([image[..., :3] for image in images]).astype(np.float64)


def main() -> None:
    parser = argparse.ArgumentParser(description="Measures the denoiser on a shot's frames.")
    parser.add_argument("shot", type=Path)
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--samples", default="1,4,16")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--truth", type=int, default=256)
    parser.add_argument("--guides", action="store_true", help="Measures other guides too.")
    parser.add_argument("--still", action="store_true", help="And noise that stands still.")
    asked = parser.parse_args()
    shot = load_shot(asked.shot, asked.set)
    frames, filter_ = Frames(shot), Filter(machine.cores())
    a, b = (stack(frames.render(asked.truth, seed)) for seed in TRUTH_SEEDS)
    weight = 1 / (((a + b) / 2) ** 2 + 0.01)

    def error(x: Stack) -> float:
        return float(np.mean((x - a) * (x - b) * weight))

    def change(x: Stack, y: Stack) -> float:
        """Of two sequences' frame-to-frame changes, the mean product."""
        both = np.diff(x, axis=0) * np.diff(y, axis=0)
        return float(np.mean(both * (weight[1:] + weight[:-1]) / 2))

    truth_change = change(a, b) ** 0.5 if len(a) > 1 else 0.0
    print(f"the truth changes by {truth_change:.2%} from frame to frame")
    print("samples | noise | guide | quality | relMSE | flicker | core seconds")
    for samples in map(int, asked.samples.split(",")):
        for moving in (True, False) if asked.still else (True,):
            runs = [frames.render(samples, seed, moving) for seed in range(1, asked.repeats + 1)]
            kinds = {"not denoised | -": ([stack(run) for run in runs], 0.0)}
            taking = quality_of(shot.sampling.model_copy(update={"samples": samples}))
            for name, filtered in filters(filter_, taking, asked.guides).items():
                begun = time.process_time()
                sequences = [stack([filtered(image) for image in run]) for run in runs]
                taken = (time.process_time() - begun) / (len(runs) * len(a))
                kinds[name] = sequences, taken
            for name, (sequences, taken) in kinds.items():
                errors = [error(x) for x in sequences]
                spread = np.std(errors) / max(1, len(errors) - 1) ** 0.5
                flicker = np.mean([change(x - a, x - b) for x in sequences]) if len(a) > 1 else 0.0
                print(
                    f"{samples} | {'moving' if moving else 'still'} | {name} | "
                    f"{np.mean(errors):.2e} +- {spread:.1e} | {max(0.0, flicker) ** 0.5:.2%} | "
                    f"{taken:.3f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
