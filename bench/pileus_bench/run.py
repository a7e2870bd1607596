"""Measures: every contender on every scene, one render of each in turn.

Taking turns puts whatever else the machine does on all alike, so that ratios survive it.
"""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean, median
from typing import Any

from pileus_bench.contenders import Contender
from pileus_bench.measures import Image, Truth, errors, relative_noise
from pileus_bench.process import RendererError, RendererProcess, Spent
from pileus_bench.results import Point, Start, TruthRecord
from pileus_bench.scenes import BenchScene, view_of
from pileus_bench.truths import truth_of

Note = Callable[[str], None]
PROBE_SAMPLES = 2
MOST_SAMPLES = 1 << 16


@dataclass(frozen=True)
class Plan:
    """How much to measure: budgets are core seconds a render, and tolerances for `auto`."""

    budgets: tuple[float, ...]
    tolerances: tuple[float, ...]
    repeats: int
    truth_noise: float
    truth_seconds: float
    scale: float


@dataclass
class _Runs:
    """One contender at one budget: by frame, its repeats."""

    images: list[list[Image]] = field(default_factory=list)
    spent: list[list[Spent]] = field(default_factory=list)
    samples: list[int] = field(default_factory=list)

    def begin(self, samples: int) -> None:
        """Begins a frame, with so many samples a pixel at most."""
        self.images.append([])
        self.spent.append([])
        self.samples.append(samples)


Runs = dict[tuple[Contender, float], _Runs]


class Measurement:
    """The renderers' processes, for as long as it is entered, and what was measured so far."""

    def __init__(self, plan: Plan, data: Path, pythons: dict[str, str], note: Note) -> None:
        self._plan, self._data, self._note = plan, data, note
        self._pythons = pythons
        self._stack = ExitStack()
        self._processes: dict[str, RendererProcess] = {}
        self.points: list[Point] = []
        self.truths: list[TruthRecord] = []
        self.starts: dict[str, Start] = {}
        self.skipped: list[str] = []

    def __enter__(self) -> "Measurement":
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def start(self, contenders: Iterable[Contender]) -> list[Contender]:
        """Those whose renderer is here; one line is noted for each that is not."""
        absent: set[str] = set()
        for module in dict.fromkeys(each.renderer for each in contenders):
            if module in self._processes:
                continue
            try:
                process = RendererProcess(module, self._pythons[module])
            except RendererError as error:
                absent.add(module)
                self._skip(f"{error}; skipped")
                continue
            self._processes[module] = self._stack.enter_context(process)
            self.starts[module] = Start(
                renderer=process.about, start=process.start_seconds, load={}
            )
        return [each for each in contenders if each.renderer not in absent]

    def process(self, renderer: str) -> RendererProcess:
        """One that was started."""
        return self._processes[renderer]

    def scene(self, scene: BenchScene, contenders: Sequence[Contender]) -> None:
        runs: Runs = {
            (each, budget): _Runs()
            for each in contenders
            for budget in (self._plan.tolerances if each.by_tolerance else self._plan.budgets)
        }
        truths = []
        for frame in scene.frames:
            view = view_of(scene, frame, self._data)
            for module, process in self._processes.items():
                with self._forgiven(scene, module, runs):
                    self.starts[module].load[f"{scene.name}.{frame}"] = process.load(view).seconds
            truths.append(self._truth(scene, frame, view))
            self._calibrate(scene, runs)
            for repeat in range(self._plan.repeats):
                self._render_each(scene, runs, repeat)
        for (contender, budget), run in runs.items():
            point = _point(scene.name, contender, budget, run, truths)
            self.points.append(point)
            self._note(
                f"{scene.name}: {contender.name}, {point.samples:.0f} samples, "
                f"{point.seconds:.2f} s, {point.cpu_seconds:.2f} core s, relMSE "
                f"{point.trimmed.value:.3g}, mean {point.mean_ratio:.4f} "
                f"+- {point.mean_ratio_error:.4f}"
            )

    def _truth(self, scene: BenchScene, frame: int, view: dict[str, Any]) -> Truth:
        plan = self._plan
        truth, samples = truth_of(
            view, self._processes["pileus"].render, plan.truth_noise, plan.truth_seconds, self._data
        )
        self.truths.append(
            TruthRecord(scene=scene.name, frame=frame, samples=samples, noise=truth.noise)
        )
        self._note(f"{scene.name}.{frame}: truth of 2 x {samples} samples, noise {truth.noise:.2g}")
        return truth

    def _calibrate(self, scene: BenchScene, runs: Runs) -> None:
        """Finds how many samples each contender's budgets buy, and begins a frame."""
        costs: dict[str, float] = {}
        for (contender, _), run in runs.items():
            if contender.by_tolerance:
                run.begin(MOST_SAMPLES)
        fixed = (contender for contender, _ in runs if not contender.by_tolerance)
        for contender in list(dict.fromkeys(fixed)):
            with self._forgiven(scene, contender.renderer, runs):
                # Samples alone: a denoiser's time comes on top of what its budget buys.
                settings = {**contender.settings, "denoise": False}
                kind = json.dumps([contender.renderer, settings])
                if kind not in costs:
                    process = self._processes[contender.renderer]
                    _, probe = process.render(settings, PROBE_SAMPLES, 0)
                    costs[kind] = max(probe.cpu_seconds, 1e-4) / PROBE_SAMPLES
                for budget in self._plan.budgets:
                    runs[contender, budget].begin(_samples(budget, costs[kind]))

    def _render_each(self, scene: BenchScene, runs: Runs, repeat: int) -> None:
        for (contender, budget), run in list(runs.items()):
            settings = dict(contender.settings)
            if contender.by_tolerance:
                settings["tolerance"] = budget
            with self._forgiven(scene, contender.renderer, runs):
                image, spent = self._processes[contender.renderer].render(
                    settings, run.samples[-1], 1 + repeat
                )
                run.images[-1].append(image)
                run.spent[-1].append(spent)

    @contextmanager
    def _forgiven(self, scene: BenchScene, renderer: str, runs: Runs) -> Iterator[None]:
        """A peer that fails is left out of the scene; Pileus may not fail."""
        try:
            yield
        except RendererError as error:
            if renderer == "pileus":
                raise
            if any(contender.renderer == renderer for contender, _ in runs):
                self._skip(f"{scene.name}: {error}; skipped")
            for key in [key for key in runs if key[0].renderer == renderer]:
                del runs[key]

    def _skip(self, line: str) -> None:
        self.skipped.append(line)
        self._note(line)


def _samples(budget: float, per_sample: float) -> int:
    """A power of two, which suits every stratified sampler."""
    return int(2 ** max(0, min(round(math.log2(budget / per_sample)), math.log2(MOST_SAMPLES))))


def _point(
    scene: str, contender: Contender, budget: float, run: _Runs, truths: Sequence[Truth]
) -> Point:
    found = errors(list(zip(run.images, truths, strict=True)))
    return Point(
        scene=scene,
        contender=contender.name,
        peer=contender.peer,
        denoised=contender.denoised,
        budget=budget,
        samples=mean(
            mean(asked if s.samples is None else s.samples for s in each)
            for asked, each in zip(run.samples, run.spent, strict=True)
        ),
        seconds=mean(median(s.seconds for s in each) for each in run.spent),
        cpu_seconds=mean(median(s.cpu_seconds for s in each) for each in run.spent),
        rel_mse=found.rel_mse,
        trimmed=found.trimmed,
        noise=found.noise,
        own_noise=mean(
            relative_noise(images, truth) for images, truth in zip(run.images, truths, strict=True)
        ),
        bias=found.bias,
        mean_ratio=found.mean_ratio,
        mean_ratio_error=found.mean_ratio_error,
    )
