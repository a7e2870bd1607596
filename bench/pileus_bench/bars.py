"""The bars: what a chart's points say of the ratios that Pileus sets out to reach."""

import math
from collections.abc import Callable, Iterable, Sequence

from pileus_bench.results import Bar, Point

TARGET = 2.5e-3


def bars_of(points: Sequence[Point]) -> list[Bar]:
    return [
        _reference(points, "core seconds", lambda p: p.cpu_efficiency),
        _reference(points, "wall seconds", lambda p: p.efficiency),
        _auto(points, "auto"),
        _auto(points, "auto + OIDN"),
        _multiple(points),
        _multiple_to_target(points),
    ]


def geometric_mean(values: Iterable[float]) -> float | None:
    logs = [math.log(value) for value in values]
    return math.exp(sum(logs) / len(logs)) if logs else None


def efficiency(
    points: Sequence[Point], scene: str, contender: str, of: Callable[[Point], float]
) -> float | None:
    """Over a contender's budgets on a scene: those of an unbiased one differ by chance alone."""
    return geometric_mean(of(p) for p in _of(points, scene, contender))


def seconds_to(points: Sequence[Point], scene: str, contender: str, target: float) -> float | None:
    """Core seconds to a relMSE: what the bias leaves of it is the noise's, which falls as 1 / time,
    but not below a sample a pixel.

    None where the bias alone is more, or nothing was measured.
    """
    found = []
    for p in _of(points, scene, contender):
        bias = max(p.bias.value, 0.0) if p.bias.low > 0 else 0.0
        if bias >= target:
            return None
        noise = max(p.trimmed.value - bias, 1e-12)
        found.append(p.cpu_seconds * noise / (target - bias))
    return _no_less_than_a_sample(geometric_mean(found), points, scene, contender)


def _of(points: Sequence[Point], scene: str, contender: str) -> list[Point]:
    return [p for p in points if (p.scene, p.contender) == (scene, contender)]


def _no_less_than_a_sample(
    seconds: float | None, points: Sequence[Point], scene: str, contender: str
) -> float | None:
    """Core seconds, or those of one sample a pixel where that is more: nobody renders less."""
    if seconds is None:
        return None
    return max(seconds, min(p.cpu_seconds / p.samples for p in _of(points, scene, contender)))


def _auto(points: Sequence[Point], name: str) -> Bar:
    """The core seconds of `auto` at the target's tolerance, denoised or not, against what the
    better peer without a denoiser needs for the target. Scenes where `auto` misses it have no
    ratio."""
    ratios = {}
    rivals = dict.fromkeys(p.contender for p in points if p.peer and not p.denoised)
    for p in points:
        if (p.contender, p.budget) != (name, TARGET**0.5) or p.trimmed.value > TARGET:
            continue
        theirs = [s for rival in rivals if (s := seconds_to(points, p.scene, rival, TARGET))]
        if theirs:
            ratios[p.scene] = min(theirs) / p.cpu_seconds
    return Bar(
        what=f"{name} at tolerance {TARGET**0.5:g} against the better peer without a denoiser, "
        f"core seconds to a relMSE of {TARGET:g}",
        wanted="100",
        values=ratios,
        mean=geometric_mean(ratios.values()),
    )


def _reference(points: Sequence[Point], unit: str, of: Callable[[Point], float]) -> Bar:
    """`reference` against the better peer, neither denoised, by 1 / (relMSE x seconds)."""
    ratios = {}
    rivals = dict.fromkeys(p.contender for p in points if p.peer and not p.denoised)
    for scene in dict.fromkeys(p.scene for p in points):
        ours = efficiency(points, scene, "reference", of)
        theirs = [e for name in rivals if (e := efficiency(points, scene, name, of)) is not None]
        if ours is not None and theirs:
            ratios[scene] = ours / max(theirs)
    return Bar(
        what=f"reference against the better peer, 1 / (relMSE x {unit})",
        wanted="20 on the mean, 8 on the worst scene",
        values=ratios,
        mean=geometric_mean(ratios.values()),
    )


def _multiple(points: Sequence[Point]) -> Bar:
    """Core seconds to equal noise, each method's noise relative to its own mean image and both
    exposed alike."""
    return _against_single(
        points,
        "multiple at 16 orders against single, both exposed alike, time at equal noise",
        _noise_seconds,
    )


def _multiple_to_target(points: Sequence[Point]) -> Bar:
    """The same to a noise that is wanted: `single`, which marches the whole ray, may have less of
    it with the first sample than anybody sees."""

    def to_target(points: Sequence[Point], scene: str, name: str) -> float | None:
        seconds = _noise_seconds(points, scene, name)
        wanted = None if seconds is None else seconds / TARGET
        return _no_less_than_a_sample(wanted, points, scene, name)

    return _against_single(
        points,
        f"multiple at 16 orders against single, both exposed alike, time to a noise of {TARGET:g}, "
        "a sample a pixel or more",
        to_target,
    )


def _noise_seconds(points: Sequence[Point], scene: str, name: str) -> float | None:
    return geometric_mean(p.own_noise * p.cpu_seconds for p in _of(points, scene, name))


def _against_single(
    points: Sequence[Point],
    what: str,
    cost: Callable[[Sequence[Point], str, str], float | None],
) -> Bar:
    ratios = {}
    for scene in dict.fromkeys(p.scene for p in points):
        multiple, single = (cost(points, scene, name) for name in ("multiple", "single"))
        if multiple is not None and single is not None:
            ratios[scene] = multiple / single
    return Bar(what=what, wanted="at most 4", values=ratios, mean=geometric_mean(ratios.values()))
