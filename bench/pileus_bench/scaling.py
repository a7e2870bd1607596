"""Costs that need no truth: finer caches of the same picture, and one thread more.

python -m pileus_bench.scaling refinement|threads [--methods A,B] [--repeats N] [--data DIR]
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import pileus_core as core

from pileus_bench.contenders import Contender, methods
from pileus_bench.process import RendererProcess, Spent
from pileus_bench.results import Bar
from pileus_bench.scenes import cache_folder, load_scene, view_of

SCENE = "backward"
SAMPLES = 32
COARSE, FINE = 96, 192


def refinement(
    renderer: RendererProcess,
    contenders: Sequence[Contender],
    repeats: int,
    scale: float,
    data: Path,
) -> Bar:
    """Core seconds with voxels of half the side over those with whole ones, by method."""
    spent: dict[tuple[str, int], list[float]] = {}
    for repeat in range(repeats):
        for resolution in (COARSE, FINE):
            scene = load_scene(SCENE, scale, data / f"at{resolution}", data, resolution)
            renderer.load(view_of(scene, scene.frames[0], data / f"at{resolution}"))
            for method in contenders:
                _, took = renderer.render(method.settings, SAMPLES, repeat)
                spent.setdefault((method.name, resolution), []).append(took.cpu_seconds)
    return Bar(
        what="a cache refined 8-fold in voxels, core seconds over the coarse one's, by method",
        wanted="at most 1.3",
        values={
            method.name: median(spent[method.name, FINE]) / median(spent[method.name, COARSE])
            for method in contenders
        },
    )


def threads(
    renderer: RendererProcess,
    contenders: Sequence[Contender],
    repeats: int,
    scale: float,
    data: Path,
) -> list[Bar]:
    """What a second thread brings, by method: in wall seconds, the least of the repeats, and, where
    a busy machine spoils those, in core seconds, which know nothing of threads that wait."""
    scene = load_scene(SCENE, scale, data, data)
    renderer.load(view_of(scene, scene.frames[0], data))
    spent: dict[tuple[str, int], list[Spent]] = {}
    for repeat in range(repeats):
        for count in (1, 2):
            for method in contenders:
                settings = {**method.settings, "threads": count}
                _, took = renderer.render(settings, SAMPLES, repeat)
                spent.setdefault((method.name, count), []).append(took)

    def wall(name: str, count: int) -> float:
        return min(each.seconds for each in spent[name, count])

    def cores(name: str, count: int) -> float:
        return median(each.cpu_seconds for each in spent[name, count])

    names = [method.name for method in contenders]
    return [
        Bar(
            what="2 threads against 1, wall seconds, by method",
            wanted="at least 1.9",
            values={name: wall(name, 1) / wall(name, 2) for name in names},
        ),
        Bar(
            what="2 threads against 1, twice the ratio of core seconds, by method",
            wanted="at least 1.9",
            values={name: 2 * cores(name, 1) / cores(name, 2) for name in names},
        ),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description="Measures how costs grow and shrink.")
    parser.add_argument("what", choices=["refinement", "threads"])
    parser.add_argument("--methods", default=",".join(core.METHODS))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--data", type=Path, default=cache_folder())
    asked = parser.parse_args()
    chosen = [each for each in methods() if each.name in asked.methods.split(",")]
    data = asked.data.resolve()
    with RendererProcess("pileus", sys.executable) as renderer:
        if asked.what == "refinement":
            bars = [refinement(renderer, chosen, asked.repeats, asked.scale, data)]
        else:
            bars = threads(renderer, chosen, asked.repeats, asked.scale, data)
    for bar in bars:
        told = ", ".join(f"{name} {value:.3g}" for name, value in bar.values.items())
        print(f"{bar.what} ({bar.wanted}): {told}")


if __name__ == "__main__":
    main()
