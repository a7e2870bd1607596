"""Who is measured: every method of Pileus, and the peers with their settings."""

from dataclasses import dataclass, field
from typing import Any

import pileus_core as core


@dataclass(frozen=True)
class Contender:
    """A renderer's module with the settings that its `render` takes."""

    name: str
    renderer: str
    settings: dict[str, Any] = field(default_factory=dict, hash=False)
    denoised: bool = False

    @property
    def peer(self) -> bool:
        return self.renderer != "pileus"


def methods() -> list[Contender]:
    return [
        Contender(name, "pileus", {"transport": {"method": name, "max_bounces": None}})
        for name in core.METHODS
    ]


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
