"""The chart for people: a panel a scene, error against core seconds, both logarithmic."""

import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from pileus_bench.results import Chart, Point

Colour = tuple[float, float, float, float]
COLUMNS = 4
MARKERS = "osD^vP*Xph"


def draw(chart: Chart, folder: Path) -> None:
    """Writes chart.png and chart.svg."""
    scenes = list(dict.fromkeys(point.scene for point in chart.points))
    names = list(dict.fromkeys(point.contender for point in chart.points))
    colours = {name: colormaps["tab20"](index % 20) for index, name in enumerate(names)}
    markers = {name: MARKERS[index % len(MARKERS)] for index, name in enumerate(names)}
    rows = math.ceil((len(scenes) + 1) / COLUMNS)
    figure = Figure(figsize=(4 * COLUMNS, 3.4 * rows), layout="constrained")
    axes = figure.subplots(rows, COLUMNS, squeeze=False)
    panels = list(axes.flat)
    for panel, scene in zip(panels, scenes, strict=False):
        points = [point for point in chart.points if point.scene == scene]
        _panel(panel, scene, points, colours, markers)
    for panel in panels[len(scenes) :]:
        panel.axis("off")
    panels[len(scenes)].legend(handles=_legend(chart, colours, markers), loc="center", fontsize=8)
    for kind in ("png", "svg"):
        figure.savefig(folder / f"chart.{kind}", dpi=110)


def front(points: Sequence[Point]) -> list[Point]:
    """Those that no other beats in both time and error, by rising time."""
    best: list[Point] = []
    for point in sorted(points, key=lambda p: p.cpu_seconds):
        if not best or point.trimmed.value < best[-1].trimmed.value:
            best.append(point)
    return best


def _panel(
    panel: Axes,
    scene: str,
    points: Sequence[Point],
    colours: dict[str, Colour],
    markers: dict[str, str],
) -> None:
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_title(scene, fontsize=10)
    panel.set_xlabel("core seconds", fontsize=8)
    panel.set_ylabel("relMSE", fontsize=8)
    panel.tick_params(which="both", labelsize=7)
    # Few decades of time: 1, 2 and 5 in each, as plain numbers.
    panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    panel.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    panel.xaxis.set_minor_formatter(NullFormatter())
    panel.grid(alpha=0.2, which="both")
    ours = front([point for point in points if not point.peer])
    panel.plot(
        [point.cpu_seconds for point in ours],
        [point.trimmed.value for point in ours],
        color="0.8",
        linewidth=7,
        solid_capstyle="round",
        zorder=0,
    )
    for name in dict.fromkeys(point.contender for point in points):
        own = sorted((p for p in points if p.contender == name), key=lambda p: p.cpu_seconds)
        seconds = [p.cpu_seconds for p in own]
        values = [p.trimmed.value for p in own]
        reach = [
            [max(v - p.trimmed.low, 0.0) for v, p in zip(values, own, strict=True)],
            [max(p.trimmed.high - v, 0.0) for v, p in zip(values, own, strict=True)],
        ]
        panel.errorbar(
            seconds,
            values,
            yerr=reach,
            color=colours[name],
            marker=markers[name],
            markersize=4,
            linewidth=1,
            linestyle="--" if own[0].peer else "-",
            capsize=2,
        )
        panel.plot(seconds, [p.noise for p in own], color=colours[name], linestyle=":", alpha=0.6)
        last = own[-1]
        if last.bias.low > 0:
            panel.plot(
                [seconds[0], seconds[-1] * 1.6],
                [last.bias.value] * 2,
                color=colours[name],
                linewidth=0.8,
                linestyle="-.",
            )


def _legend(chart: Chart, colours: dict[str, Colour], markers: dict[str, str]) -> list[Line2D]:
    peers = {point.contender for point in chart.points if point.peer}
    lines = [
        Line2D(
            [],
            [],
            color=colours[name],
            marker=markers[name],
            markersize=4,
            linestyle="--" if name in peers else "-",
            label=name,
        )
        for name in markers
    ]
    return [
        *lines,
        Line2D([], [], color="0.8", linewidth=7, label="Pareto front of Pileus"),
        Line2D([], [], color="0.3", linestyle=":", label="its noise alone"),
        Line2D([], [], color="0.3", linestyle="-.", label="its bias alone, where it is sure"),
    ]
