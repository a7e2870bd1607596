"""What orders after the first cost in noise under a look, for which `multiple` is there.

The points of a chart are physical, for they have a truth to meet. A look dims and blunts each
further order, and its noise with it.
"""

from collections.abc import Sequence
from pathlib import Path

from pileus_bench.bars import geometric_mean
from pileus_bench.measures import relative_noise
from pileus_bench.process import RendererProcess
from pileus_bench.results import Bar
from pileus_bench.run import Plan
from pileus_bench.scenes import AbsentError, load_scene, view_of
from pileus_bench.truths import truth_of

LOOK = {"name": "hero", "a": 0.65, "b": 0.65, "c": 0.5}  # MoonRay's defaults for the same method
SAMPLES = 32


def against_single(
    renderer: RendererProcess, names: Sequence[str], plan: Plan, data: Path, shared: Path
) -> Bar:
    """Core seconds of `multiple` to equal noise over those of `single`, by scene, on its first
    frame."""
    ratios = {}
    for name in names:
        try:
            scene = load_scene(name, plan.scale, data, shared)
            view = view_of(scene, scene.frames[0], data)
        except AbsentError:
            continue
        renderer.load(view)
        truth, _ = truth_of(view, renderer.render, plan.truth_noise, plan.truth_seconds, data)
        costs = {}
        for method in ("single", "multiple"):
            transport = {"method": method, "max_bounces": None, "looks": [LOOK]}
            renders = [
                renderer.render({"transport": transport}, SAMPLES, 1 + repeat)
                for repeat in range(plan.repeats)
            ]
            seconds = sum(spent.cpu_seconds for _, spent in renders)
            costs[method] = relative_noise([image for image, _ in renders], truth) * seconds
        ratios[name] = costs["multiple"] / costs["single"]
    return Bar(
        what="multiple at 16 orders against single, both exposed alike, under MoonRay's default "
        f"look (a {LOOK['a']}, b {LOOK['b']}, c {LOOK['c']}), time at equal noise",
        wanted="at most 4",
        values=ratios,
        mean=geometric_mean(ratios.values()),
    )
