"""Costs that need no truth: finer caches of the same picture, and one thread more."""

from collections.abc import Sequence
from pathlib import Path
from statistics import median

from pileus_bench.contenders import Contender
from pileus_bench.process import RendererProcess, Spent
from pileus_bench.results import Bar
from pileus_bench.run import Plan
from pileus_bench.scenes import load_scene, view_of

SCENE = "backward"
SAMPLES = 32
COARSE, FINE = 96, 192


def refinement(
    renderer: RendererProcess, methods: Sequence[Contender], plan: Plan, data: Path
) -> Bar:
    """Core seconds with voxels of half the side over those with whole ones, by method."""
    spent: dict[tuple[str, int], list[float]] = {}
    for repeat in range(plan.repeats):
        for resolution in (COARSE, FINE):
            scene = load_scene(SCENE, plan.scale, data / f"at{resolution}", data, resolution)
            renderer.load(view_of(scene, scene.frames[0], data / f"at{resolution}"))
            for method in methods:
                _, took = renderer.render(method.settings, SAMPLES, repeat)
                spent.setdefault((method.name, resolution), []).append(took.cpu_seconds)
    return Bar(
        what="a cache refined 8-fold in voxels, core seconds over the coarse one's, by method",
        wanted="at most 1.3",
        values={
            method.name: median(spent[method.name, FINE]) / median(spent[method.name, COARSE])
            for method in methods
        },
    )


def threads(
    renderer: RendererProcess, methods: Sequence[Contender], plan: Plan, data: Path
) -> list[Bar]:
    """What a second thread brings, by method: in wall seconds, the least of the repeats, and, where
    a busy machine spoils those, in core seconds, which know nothing of threads that wait."""
    scene = load_scene(SCENE, plan.scale, data, data)
    renderer.load(view_of(scene, scene.frames[0], data))
    spent: dict[tuple[str, int], list[Spent]] = {}
    for repeat in range(plan.repeats):
        for count in (1, 2):
            for method in methods:
                settings = {**method.settings, "threads": count}
                _, took = renderer.render(settings, SAMPLES, repeat)
                spent.setdefault((method.name, count), []).append(took)

    def wall(name: str, count: int) -> float:
        return min(each.seconds for each in spent[name, count])

    def cores(name: str, count: int) -> float:
        return median(each.cpu_seconds for each in spent[name, count])

    names = [method.name for method in methods]
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
