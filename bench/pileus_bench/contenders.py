"""Who is measured: every method of Pileus, and the peers with their settings."""

from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

import pileus_core as core


@dataclass(frozen=True)
class Contender:
    """A renderer's module with the settings that its `render` takes."""

    name: str
    renderer: str
    settings: dict[str, Any] = field(default_factory=dict, hash=False)
    denoised: bool = False
    by_tolerance: bool = False  # its budgets are tolerances, not core seconds

    @property
    def peer(self) -> bool:
        return self.renderer != "pileus"


def methods() -> list[Contender]:
    """With `auto` last, and once more denoised where OIDN is installed."""

    def settings(name: str, denoise: bool = False) -> dict[str, Any]:
        return {"transport": {"method": name, "max_bounces": None}, "denoise": denoise}

    fixed = [Contender(name, "pileus", settings(name)) for name in core.METHODS]
    auto = [Contender("auto", "pileus", settings("auto"), by_tolerance=True)]
    if find_spec("pyoidn") is not None:
        denoised = settings("auto", denoise=True)
        auto.append(Contender("auto + OIDN", "pileus", denoised, denoised=True, by_tolerance=True))
    return fixed + auto


def _cycles(name: str, biased: bool, denoise: bool) -> Contender:
    return Contender(name, "cycles", {"biased": biased, "denoise": denoise}, denoise)


CYCLES_DENOISED = _cycles("Cycles + OIDN", biased=False, denoise=True)
PEERS = [
    Contender("Mitsuba 3", "mitsuba_volpath"),
    _cycles("Cycles", biased=False, denoise=False),
    _cycles("Cycles biased", biased=True, denoise=False),
    CYCLES_DENOISED,
    _cycles("Cycles biased + OIDN", biased=True, denoise=True),
]
