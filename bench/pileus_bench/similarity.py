"""What `similarity` leaves out, and what that is worth, by the event from which it reduces.

    python -m pileus_bench.similarity [--starts 2,3,6,9] [--samples 128] [--scenes A,B]

On each scene the RMS relative bias over pixels and the speed: the core seconds that `reference`
needs to equal noise over those of `similarity`.
"""

from statistics import mean
from typing import Any

from pileus_bench.here import Here, parser, ready
from pileus_bench.measures import Errors, Truth, errors

REPEATS = 4


def measured(
    renderer: Here, truth: Truth, transport: dict[str, Any], samples: int
) -> tuple[Errors, float]:
    """The errors, and the core seconds to a noise of 1."""
    settings = {"transport": {"max_bounces": None, **transport}}
    runs = [renderer.timed(settings, samples, seed) for seed in range(1, REPEATS + 1)]
    found = errors([([image for image, _ in runs], truth)])
    return found, found.noise * mean(spent.cpu_seconds for _, spent in runs)


def bias(found: Errors) -> str:
    """Its root, with the end of the interval where it cannot be told from 0."""
    if found.bias.low > 0:
        return f"{found.bias.value**0.5:.1%}"
    return f"< {max(found.bias.high, 0.0) ** 0.5:.1%}"


def main() -> None:
    options = parser("Measures the bias of `similarity`.")
    options.add_argument("--starts", default="2,3,6,9")
    options.add_argument("--samples", type=int, default=128)
    asked = options.parse_args()
    starts = [int(start) for start in asked.starts.split(",")]
    head = ["scene", *(f"from {start}" for start in starts)]
    print(f"| {' | '.join(head)} |\n{'|---' * len(head)}|")
    for name, renderer, truth in ready(asked):
        _, reference = measured(renderer, truth, {"method": "reference"}, asked.samples)
        cells = []
        for start in starts:
            transport = {"method": "similarity", "reduce_from": start}
            found, cost = measured(renderer, truth, transport, asked.samples)
            cells.append(f"{bias(found)}, {reference / cost:.2g}x")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
