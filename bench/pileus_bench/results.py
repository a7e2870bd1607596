"""What a chart holds, as JSON for programs."""

from typing import Literal

from pydantic import BaseModel, ConfigDict

from pileus_bench.measures import Estimate


class Record(BaseModel):
    model_config = ConfigDict(frozen=True)


class TruthRecord(Record):
    """`samples` is that of each half; `noise` is the relMSE that the two together still have."""

    scene: str
    frame: int
    samples: int
    noise: float


class Point(Record):
    """One contender at one budget on one scene, means over its frames. The budget is a tolerance
    for `auto`, core seconds for all others.

    Errors are relMSE without the truth's noise; `trimmed` leaves the worst 0.1 % of pixels out.
    `seconds` are wall, `cpu_seconds` the processor's over all threads.
    """

    scene: str
    contender: str
    peer: bool
    denoised: bool
    budget: float
    samples: float
    seconds: float
    cpu_seconds: float
    rel_mse: Estimate
    trimmed: Estimate
    noise: float
    own_noise: float
    bias: Estimate
    mean_ratio: float
    mean_ratio_error: float

    @property
    def efficiency(self) -> float:
        """1 / (trimmed relMSE x wall seconds)."""
        return 1 / (max(self.trimmed.value, 1e-12) * self.seconds)

    @property
    def cpu_efficiency(self) -> float:
        """1 / (trimmed relMSE x core seconds): steady on a busy machine."""
        return 1 / (max(self.trimmed.value, 1e-12) * self.cpu_seconds)


class Start(Record):
    """What a renderer's process took to start, and to load a scene's frames, in seconds."""

    renderer: str
    start: float
    load: dict[str, float]


class Bar(Record):
    """A ratio that is wanted and what was measured: by scene or by method, and on the mean."""

    what: str
    wanted: str
    values: dict[str, float]
    mean: float | None = None


class EndToEnd(Record):
    """One render from a cache on disk to an image on disk, denoised."""

    scene: str
    contender: str
    samples: int
    rel_mse: float
    seconds: float
    cpu_seconds: float


class Chart(Record):
    kind: Literal["small", "full"]
    command: str
    version: str
    processor: str
    cores: int
    load: float
    scale: float
    repeats: int
    truths: list[TruthRecord]
    points: list[Point]
    starts: list[Start]
    end_to_end: list[EndToEnd]
    bars: list[Bar]
    skipped: list[str]
