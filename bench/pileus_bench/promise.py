"""Does `auto` keep its promise, and what does that cost?

    python -m pileus_bench.promise [--tolerance 0.05] [--denoise] [--scenes A,B] [--data DIR]

On each scene `auto` renders with five seeds. The error against the truth must stay within the
tolerance; the cost is set against the best fixed choice: of all methods and sample counts the
cheapest that keeps the same promise with the same seeds, as one would find it by trying. With
`--denoise` only `auto` is denoised.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean
from typing import Any

import numpy as np

from pileus_bench.here import Here, parser, ready
from pileus_bench.measures import Truth, error, errors

SEEDS = range(1, 6)
AUTO = {"transport": {"method": "auto", "max_bounces": None}}
MOST_SAMPLES = 1 << 14
PROBE_SAMPLES = 8
STEP = 1.06  # between the counts of samples that are tried


def choices() -> dict[str, dict[str, Any]]:
    """The fixed choices, but for their sample counts: the settings that render each."""

    def settings(method: str, **more: Any) -> dict[str, Any]:
        return {"transport": {"method": method, "max_bounces": None, **more}}

    plain = {name: settings(name) for name in ("single", "multiple", "density", "reference")}
    first = {"first order": settings("reference", max_bounces=1)}
    reduced = {f"similarity {n}": settings("similarity", reduce_from=n) for n in (2, 3, 6)}
    return plain | first | reduced


@dataclass(frozen=True)
class Fixed:
    """A fixed choice, with as many samples as it seems to need and their cost."""

    name: str
    settings: dict[str, Any]
    samples: float
    seconds: float


def guesses(renderer: Here, truth: Truth, tolerance: float) -> list[Fixed]:
    """What each choice seems to need, from a few samples; the cheapest first."""
    found = []
    for name, settings in choices().items():
        runs = [renderer.timed(settings, PROBE_SAMPLES, seed) for seed in SEEDS]
        seen = errors([([image for image, _ in runs], truth)])
        left = tolerance**2 - max(seen.bias.low, 0.0)
        if left > 0:
            samples = max(1.0, PROBE_SAMPLES * seen.noise / left)
            cost = mean(spent.cpu_seconds for _, spent in runs) / PROBE_SAMPLES
            found.append(Fixed(name, settings, samples, samples * cost))
    return sorted(found, key=lambda each: each.seconds)


def kept(renderer: Here, truth: Truth, fixed: Fixed, samples: int, tolerance: float) -> bool:
    return all(
        error(renderer.timed(fixed.settings, samples, seed)[0], truth) <= tolerance**2
        for seed in SEEDS
    )


def fewest(renderer: Here, truth: Truth, fixed: Fixed, tolerance: float) -> int | None:
    """The fewest samples that keep the tolerance with every seed."""
    samples = max(1, math.floor(0.8 * fixed.samples))
    while samples <= min(MOST_SAMPLES, 4 * fixed.samples + 4):
        if kept(renderer, truth, fixed, samples, tolerance):
            return samples
        samples = max(samples + 1, math.floor(samples * STEP))
    return None


def best(renderer: Here, truth: Truth, tolerance: float) -> tuple[Fixed, int] | None:
    """The cheapest choice of the two that look best, and its samples."""
    found = []
    for guess in guesses(renderer, truth, tolerance)[:2]:
        if (samples := fewest(renderer, truth, guess, tolerance)) is not None:
            found.append((guess.seconds / guess.samples * samples, guess, samples))
    if not found:
        return None
    _, fixed, samples = min(found, key=lambda each: each[0])
    return fixed, samples


@dataclass(frozen=True)
class Outcome:
    """`auto` against the best fixed choice on one scene; seconds are core seconds."""

    errors: list[float]
    seconds: float
    fixed_seconds: float

    @property
    def ratio(self) -> float:
        return self.seconds / self.fixed_seconds


def measure(
    name: str, renderer: Here, truth: Truth, tolerance: float, denoise: bool
) -> Outcome | None:
    """Prints the scene's row."""
    found = best(renderer, truth, tolerance)
    if found is None:
        print(f"| {name} | no fixed choice keeps the tolerance |")
        return None
    fixed, samples = found
    wanted = AUTO | {"tolerance": tolerance, "denoise": denoise}
    seen, ours, theirs, counts = [], [], [], []
    for seed in SEEDS:
        image, spent = renderer.timed(wanted, MOST_SAMPLES, seed)
        seen.append(math.sqrt(max(0.0, error(image, truth))))
        ours.append(spent.cpu_seconds)
        counts.append(renderer.samples)
        decided = renderer.resolved
        theirs.append(renderer.timed(fixed.settings, samples, seed)[1].cpu_seconds)
    outcome = Outcome(seen, mean(ours), mean(theirs))
    start = f" {decided.reduce_from}" if decided.method == "similarity" else ""
    depth = f", {decided.max_bounces} orders" if decided.max_bounces else ""
    print(
        f"| {name} | {decided.method}{start}{depth}, {mean(counts):.1f} | "
        f"{' '.join(f'{100 * each:.2f}' for each in seen)} | {outcome.seconds:.3g} | "
        f"{fixed.name}, {samples} | {outcome.fixed_seconds:.3g} | {outcome.ratio:.2f} |",
        flush=True,
    )
    return outcome


def summary(outcomes: Sequence[Outcome], tolerance: float) -> str:
    held = [each <= tolerance for outcome in outcomes for each in outcome.errors]
    ratios = [outcome.ratio for outcome in outcomes]
    over = sum(ratio > 1.5 for ratio in ratios)
    return (
        f"\n{sum(held)} of {len(held)} renders within the tolerance ({np.mean(held):.0%}); cost "
        f"{math.exp(np.mean(np.log(ratios))):.2f} of the best fixed choice on the mean, "
        f"{max(ratios):.2f} at worst, over 1.5 on {over} of {len(ratios)} scenes"
    )


def main() -> None:
    options = parser("Tries the promise of `auto`.")
    options.add_argument("--tolerance", type=float, default=0.05)
    options.add_argument("--denoise", action="store_true", help="what `auto` renders")
    asked = options.parse_args()
    head = ["scene", "`auto`: method, samples", "errors of five seeds, %", "core s"]
    head += ["best fixed choice", "core s", "ratio"]
    print(f"| {' | '.join(head)} |\n{'|---' * len(head)}|")
    outcomes = []
    for name, renderer, truth in ready(asked):
        found = measure(name, renderer, truth, asked.tolerance, asked.denoise)
        if found is not None:
            outcomes.append(found)
    if outcomes:
        print(summary(outcomes, asked.tolerance))


if __name__ == "__main__":
    main()
