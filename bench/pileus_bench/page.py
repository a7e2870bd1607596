"""The page docs/speed-and-accuracy.md: what a chart shows, in words and tables."""

from collections.abc import Sequence
from pathlib import Path

from pileus_bench.bars import TARGET, efficiency, geometric_mean, seconds_to
from pileus_bench.results import Chart, EndToEnd, Point, Start

INTRODUCTION = """\
# How fast is each method, and how far from the truth?

This page is written by `make chart`: do not edit it. `{command}` measured it on {cores} cores of
{processor}{busy}.

![Error against core seconds, a panel a scene]({picture})

Each point is one method at one budget: the mean relMSE, (x-r)^2/(r^2+0.01), of {repeats} renders
with different seeds against the truth, the worst 0.1 % of pixels left out, with its 90 % bootstrap
interval over renders and 8x8 tiles. Dotted: the noise alone, from the variance between renders.
Dash-dotted: the bias alone, from products of the errors of different renders, where its interval
lies above 0. Both are free of the truth's own noise, for the truth is kept as two independent
halves. Time is that of the process's threads together (core seconds), which a busy machine
disturbs least; renderers take turns, render by render. Start-up, reading and compiling are apart.

Regenerate it with `make chart` (about half an hour; `make chart-small` draws a small one in minutes
and leaves this page alone). `make peers` installs the peers.
"""

METHOD = """\
## How it is measured

- The scenes are the shot files in `bench/pileus_bench/scenes/`. `caches.toml` beside them says how
  their caches are made; the cumulus needs `../shared/data`.
- The truth is `reference` at these counts, kept by a digest of its content. The peers' mean ratios
  in the table above are its cross-check by renderers that share no code with it.
- Mitsuba 3: `volpath` with LLVM, in one channel where the scene is grey, unlimited depth, roulette
  from bounce 65,536 on (8 where a twentieth or more is absorbed), on the voxels as a dense grid.
- Cycles 5: 1,024 bounces, no clamping, no adaptive sampling, box filter, full precision, persistent
  data. Its octree is built when a scene is loaded, and is not in the times.
"""


def write_page(chart: Chart, page: Path, picture: str) -> None:
    """Writes the whole page anew; `picture` is its path from there."""
    scenes = list(dict.fromkeys(point.scene for point in chart.points))
    names = list(dict.fromkeys(point.contender for point in chart.points))
    busy = f", with other work on them (load {chart.load:.0f})" if chart.load > chart.cores else ""
    parts = [
        INTRODUCTION.format(
            command=chart.command,
            cores=chart.cores,
            processor=chart.processor,
            busy=busy,
            picture=picture,
            repeats=chart.repeats,
        ),
        '## The bars\n\nRatios; above 1 Pileus is ahead, but for the rows that say "at most".\n',
        _bars(chart, scenes),
        "## Efficiency: 1 / (relMSE x core seconds), higher is better\n",
        _table(
            ["", *names],
            [[s, *(_number(efficiency(chart.points, s, n, _cpu)) for n in names)] for s in scenes]
            + [["mean", *(_number(_over_scenes(chart.points, scenes, n)) for n in names)]],
        ),
        f"## Core seconds to a relMSE of {TARGET:g}\n\n"
        "Bias included, and at least a sample a pixel; a dash where the bias alone is more.\n",
        _table(
            ["", *names],
            [
                [s, *(_number(seconds_to(chart.points, s, n, TARGET)) or "-" for n in names)]
                for s in scenes
            ],
        ),
        *_end_to_end(chart.end_to_end),
        "## Efficiency by wall seconds\n",
        _table(
            ["", *names],
            [[s, *(_number(efficiency(chart.points, s, n, _wall)) for n in names)] for s in scenes],
        ),
        "## Bias\n\nThe mean over the truth's mean, and in brackets the RMS relative bias over "
        "pixels; a dash where it\ncannot be told from 0. From each method's largest budget.\n",
        _table(["", *names], [[s, *(_bias(chart.points, s, n) for n in names)] for s in scenes]),
        "## The truths\n",
        _table(
            ["scene", "frame", "samples", "its own relMSE"],
            [[t.scene, str(t.frame), f"2 x {t.samples}", f"{t.noise:.1e}"] for t in chart.truths],
        ),
        "## Start-up, in seconds\n",
        _table(["renderer", "start", "loading a frame, mean", "longest"], _starts(chart.starts)),
        *([_skipped(chart.skipped)] if chart.skipped else []),
        METHOD,
    ]
    page.write_text("\n".join(parts))


def _cpu(point: Point) -> float:
    return point.cpu_efficiency


def _wall(point: Point) -> float:
    return point.efficiency


def _over_scenes(points: Sequence[Point], scenes: Sequence[str], name: str) -> float | None:
    found = [efficiency(points, scene, name, _cpu) for scene in scenes]
    return geometric_mean(value for value in found if value is not None)


def _bars(chart: Chart, scenes: Sequence[str]) -> str:
    """A row a bar; the columns are the scenes, or the methods for the bars that go by method."""
    tables = []
    for columns in (scenes, _methods(chart)):
        rows = [
            [
                bar.what,
                bar.wanted,
                *(_number(bar.values.get(column)) for column in columns),
                _number(bar.mean),
            ]
            for bar in chart.bars
            if any(column in bar.values for column in columns)
        ]
        if rows:
            tables.append(_table(["", "wanted", *columns, "mean"], rows))
    return "\n".join(tables)


def _methods(chart: Chart) -> list[str]:
    return list(dict.fromkeys(point.contender for point in chart.points if not point.peer))


def _bias(points: Sequence[Point], scene: str, name: str) -> str:
    own = [p for p in points if (p.scene, p.contender) == (scene, name)]
    if not own:
        return ""
    last = max(own, key=lambda p: p.budget)
    rms = f"{last.bias.value**0.5:.1%}" if last.bias.low > 0 else "-"
    return f"{last.mean_ratio:.3f} ({rms})"


def _end_to_end(found: Sequence[EndToEnd]) -> list[str]:
    if not found:
        return []
    head = ["scene", "", "samples", "relMSE", "seconds", "core seconds"]
    rows = [
        [
            each.scene,
            each.contender,
            str(each.samples),
            f"{each.rel_mse:.1e}",
            f"{each.seconds:.1f}",
            f"{each.cpu_seconds:.1f}",
        ]
        for each in found
    ]
    return [
        "## Denoised, from a cache on disk to an image on disk\n\nAt 960x540. Pileus with its "
        "start, the peer without.\n",
        _table(head, rows),
    ]


def _starts(starts: Sequence[Start]) -> list[list[str]]:
    return [
        [
            start.renderer,
            f"{start.start:.1f}",
            f"{sum(start.load.values()) / max(len(start.load), 1):.1f}",
            f"{max(start.load.values(), default=0.0):.1f}",
        ]
        for start in starts
    ]


def _skipped(lines: Sequence[str]) -> str:
    return "".join(["Not here when this was measured:\n\n", *(f"- {line}\n" for line in lines)])


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
