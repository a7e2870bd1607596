"""`pileus chart`: error against time, for every method and, where they are installed, the peers."""

import os
import shlex
import shutil
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import pileus_core as core
import typer

from pileus_bench.art_directed import against_single
from pileus_bench.bars import bars_of
from pileus_bench.contenders import CYCLES_DENOISED, PEERS, methods
from pileus_bench.end_to_end import denoised_bar, end_to_end
from pileus_bench.page import write_page
from pileus_bench.results import Bar, Chart, EndToEnd
from pileus_bench.run import Measurement, Plan
from pileus_bench.scaling import refinement, threads
from pileus_bench.scenes import SHARED, AbsentError, cache_folder, load_scene, scene_names
from pileus_service.errors import InputError
from pileus_worker import machine
from pileus_worker.errors import plain_errors

app = typer.Typer()

SMALL = Plan(
    budgets=(0.2, 0.8),
    tolerances=(0.1, 0.05),
    repeats=3,
    truth_noise=1e-3,
    truth_seconds=20.0,
    scale=0.5,
)
FULL = Plan(
    budgets=(0.5, 4.0),
    tolerances=(0.1, 0.05, 0.025),
    repeats=3,
    truth_noise=2e-4,
    truth_seconds=240.0,
    scale=1.0,
)


@app.command("chart")
def chart(
    peers: Annotated[
        bool, typer.Option("--peers", help="Mitsuba 3 and Cycles 5 too, where installed.")
    ] = False,
    full: Annotated[bool, typer.Option("--full", help="An hour in place of minutes.")] = False,
    scenes: Annotated[str | None, typer.Option(metavar="A,B", help="Only these scenes.")] = None,
    only: Annotated[
        str | None, typer.Option("--methods", metavar="A,B", help="Only these of our methods.")
    ] = None,
    repeats: Annotated[
        int | None, typer.Option(min=2, help="Renders of each kind, with different seeds.")
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Keeps made caches and truths here, not in ~/.cache."),
    ] = None,
    shared: Annotated[
        Path, typer.Option(metavar="DIR", help="Real caches, where there are any.")
    ] = SHARED,
    page: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Writes a page about it, with --out.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Writes chart.png, chart.svg, chart.json.")
    ] = None,
    python: Annotated[
        Path | None,
        typer.Option(envvar="PILEUS_PEERS", help="The interpreter that has the peers."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object for scripts.")] = False,
) -> None:
    """Charts error against time: scenes x methods x budgets."""
    _check_outputs(out, page)
    plan = FULL if full else SMALL
    plan = replace(plan, repeats=repeats or plan.repeats)
    data = (data or cache_folder()).resolve()
    chosen = _chosen(scenes, scene_names(), "--scenes")
    names = _chosen(only, [each.name for each in methods()], "--methods")
    ours = [each for each in methods() if each.name in names]
    peers_python = str(python or _peers_python())
    pythons = {each.renderer: peers_python for each in PEERS} | {"pileus": sys.executable}

    def note(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    bars: list[Bar] = []
    denoised: list[EndToEnd] = []

    def charted() -> Chart:
        known = [*bars_of(measurement.points), *bars]
        return Chart(
            kind="full" if full else "small",
            command=shlex.join(["pileus", *sys.argv[1:]]),
            version=core.__version__,
            processor=_processor(),
            cores=machine.cores(),
            load=os.getloadavg()[0],
            scale=plan.scale,
            repeats=plan.repeats,
            truths=measurement.truths,
            points=measurement.points,
            starts=list(measurement.starts.values()),
            end_to_end=denoised,
            bars=[bar for bar in known if bar.values],
            skipped=measurement.skipped,
        )

    with plain_errors("chart"), Measurement(plan, data, pythons, note) as measurement:
        contenders = measurement.start([*ours, *(PEERS if peers else [])])
        for name in chosen:
            try:
                scene = load_scene(name, plan.scale, data, shared)
                measurement.scene(scene, contenders)
            except AbsentError as absent:
                measurement.skipped.append(str(absent))
                note(str(absent))
            if out is not None and measurement.points:
                _write(charted(), out, page)  # an hour's work may be cut short
        pileus = measurement.process("pileus")
        if {"single", "multiple"} <= set(names):
            bars.append(against_single(pileus, chosen, plan, data, shared))
        fixed = [each for each in ours if not each.by_tolerance]
        bars.append(refinement(pileus, fixed, plan.repeats, plan.scale, data))
        bars.extend(threads(pileus, fixed, plan.repeats, plan.scale, data))
        if CYCLES_DENOISED in contenders and find_spec("pyoidn") is not None:
            denoised.extend(end_to_end(pileus, peers_python, data, shared))
            bars.append(denoised_bar(denoised))
        result = charted()
    if out is not None:
        _write(result, out, page)
    if as_json:
        print(result.model_dump_json())
    else:
        for bar in result.bars:
            values = ", ".join(f"{name} {value:.3g}" for name, value in bar.values.items())
            on_mean = f"; mean {bar.mean:.3g}" if bar.mean is not None else ""
            print(f"{bar.what} ({bar.wanted}): {values}{on_mean}")


def _check_outputs(out: Path | None, page: Path | None) -> None:
    """Says before the measuring what would fail after it."""
    if page is not None and out is None:
        raise InputError("--page needs --out, for the picture")
    if out is not None and find_spec("matplotlib") is None:
        raise InputError("--out needs matplotlib: pip install 'pileus[bench]'")


def _write(result: Chart, out: Path, page: Path | None) -> None:
    from pileus_bench.picture import draw  # needs matplotlib

    out.mkdir(parents=True, exist_ok=True)
    (out / "chart.json").write_text(result.model_dump_json(indent=1))
    draw(result, out)
    if page is not None:
        picture = page.parent / "pictures" / f"{page.stem}.png"
        picture.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(out / "chart.png", picture)
        write_page(result, page, picture.relative_to(page.parent).as_posix())


def _chosen(asked: str | None, known: list[str], option: str) -> list[str]:
    if asked is None:
        return known
    names = [name.strip() for name in asked.split(",")]
    for name in names:
        if name not in known:
            raise InputError(f"{option} {name}: not known; choose from {', '.join(known)}")
    return names


def _peers_python() -> Path:
    """`make peers` puts them in an environment inside this one."""
    beside = Path(sys.prefix) / "peers" / "bin" / "python"
    return beside if beside.is_file() else Path(sys.executable)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return "unknown"
    return next(
        (s.split(":", 1)[1].strip() for s in lines if s.startswith("model name")), "unknown"
    )
