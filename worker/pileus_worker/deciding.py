"""Resolves a frame's transport: as the shot names it, or for `auto` by measuring the frame.

The error that `sampling.tolerance` allows is shared out: at most half of it to what the model
leaves out, the rest to noise. A pilot image of a thousand pixels tells how much each order of
scattering brings; the model is then the smallest whose shortfall fits. Nothing rests on timings,
so every machine decides alike.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pileus_core as core
from numpy.typing import NDArray

from pileus_service.jobs import Bucket, Resolved
from pileus_service.shot import Shot
from pileus_worker import scene

PILOT_PIXELS = 1024
PILOT_SHARE = 0.02  # of the pixel samples that the frame may take
PILOT_ORDERS = 32
# The RMS bias of `similarity` by the event from which it reduces, as docs/methods.md measures it in
# the worst case, a sun without sky.
SIMILARITY_BIAS = {3: 0.020, 6: 0.013, 9: 0.011}
# A decision stands along a sequence until the measure has left its limit by as much.
HYSTERESIS = 1.25


@dataclass(frozen=True)
class Measure:
    """What a pilot tells: the RMS relative error of leaving out the orders from N on, N = 0 .. 32
    (33 values, falling to 0), of the look where it is greatest."""

    tail: NDArray[np.float64]


def render(
    view: core.Scene,
    shot: Shot,
    resolved: Resolved,
    *,
    frame: int,
    bucket: Bucket,
    samples: tuple[int, int],
    threads: int,
    control: core.Control,
) -> core.Partial:
    """A part of a frame as it was decided: all of its samples, or from 0 as many as its error
    wants."""
    transport = scene.make_transport(shot, resolved)
    seed, orders = shot.sampling.seed, shot.image.orders
    if resolved.noise is None:
        return core.render(
            view,
            transport,
            bucket=bucket,
            samples=samples,
            seed=seed,
            frame=frame,
            orders=orders,
            threads=threads,
            control=control,
        )
    return core.render_until(
        view,
        transport,
        bucket=bucket,
        samples=samples[1],
        tolerance=resolved.noise,
        seed=seed,
        frame=frame,
        orders=orders,
        threads=threads,
        control=control,
    )


def resolve(
    shot: Shot,
    frame: int,
    volume: Callable[[], core.Volume],
    *,
    threads: int,
    control: core.Control,
    earlier: Resolved | None = None,
    reading: scene.Opener = scene.as_named,
) -> Resolved:
    """The transport of a frame; `earlier` is what was decided for the first one of the shot. The
    volume is asked for where the frame must be measured."""
    asked = shot.transport
    if asked.method == "auto":
        measure = _pilot(shot, frame, volume(), threads, control, reading)
        return decide(shot, measure, earlier)
    depth = "the depth" if asked.max_bounces else "the method's own depth"
    return Resolved(
        method=asked.method,
        max_bounces=core.Transport(
            method=asked.method, max_bounces=asked.max_bounces, looks=scene.make_looks(shot)
        ).max_bounces,
        reduce_from=asked.reduce_from,
        noise=shot.sampling.tolerance,
        reason=f"the shot names the method, with {depth}",
    )


def _pilot(
    shot: Shot,
    frame: int,
    volume: core.Volume,
    threads: int,
    control: core.Control,
    reading: scene.Opener,
) -> Measure:
    """The frame rendered small, order by order."""
    image = shot.image
    shrink = math.sqrt(min(1.0, PILOT_PIXELS / (image.width * image.height)))
    width, height = max(1, round(image.width * shrink)), max(1, round(image.height * shrink))
    small = shot.model_copy(
        update={"image": image.model_copy(update={"width": width, "height": height})}
    )
    allowed = PILOT_SHARE * image.width * image.height * shot.sampling.samples / (width * height)
    partial = core.render(
        scene.make_scene(small, frame, volume, reading),
        core.Transport(method="similarity", max_bounces=PILOT_ORDERS, looks=scene.make_looks(shot)),
        bucket=(0, 0, width, height),
        samples=(0, int(min(max(4, allowed), 64))),
        seed=shot.sampling.seed,
        frame=frame,
        orders=True,
        threads=threads,
        control=control,
    )
    return Measure(np.max([_tail(partial.channels(name)) for name in partial.looks], axis=0))


def _tail(channels: dict[str, NDArray[np.float32]]) -> NDArray[np.float64]:
    squares = np.zeros(PILOT_ORDERS + 1)
    for colour in "RGB":
        whole = channels[colour].astype(np.float64)
        rest = np.zeros_like(whole)
        for order in reversed(range(PILOT_ORDERS)):
            rest = rest + channels[f"order{order:02d}.{colour}"]
            squares[order] += np.mean(rest**2 / (whole**2 + 0.01)) / 3
    return np.sqrt(squares)


def decide(shot: Shot, measure: Measure, earlier: Resolved | None = None) -> Resolved:
    """The smallest model whose shortfall is at most half of the tolerance."""
    tolerance = shot.sampling.tolerance
    assert tolerance is not None  # the shot's own check
    held = earlier is not None and earlier.method == "single"
    limit = tolerance / 2 * (HYSTERESIS if held else 1 / HYSTERESIS if earlier else 1.0)
    if measure.tail[1] <= limit:
        return Resolved(
            method="single",
            max_bounces=1,
            reduce_from=shot.transport.reduce_from,
            noise=_noise(tolerance, measure.tail[1]),
            reason=f"single scattering leaves out {measure.tail[1]:.1%}, "
            f"within half of the tolerance {tolerance:.1%}",
        )
    depth, cut = _depth(measure, tolerance / 4, earlier)
    if shot.transport.max_bounces is not None and (
        depth is None or shot.transport.max_bounces < depth
    ):
        depth, cut = shot.transport.max_bounces, 0.0  # the shot's own wish is no error
    reach = "all orders" if depth is None else f"{depth} orders"
    fits = [start for start, bias in SIMILARITY_BIAS.items() if bias <= tolerance / 2]
    if shot.volumes[0].anisotropy > 0 and fits:
        bias = SIMILARITY_BIAS[fits[0]]
        return Resolved(
            method="similarity",
            max_bounces=depth,
            reduce_from=fits[0],
            noise=_noise(tolerance, cut, bias),
            reason=f"{reach}: single scattering would leave out {measure.tail[1]:.1%}; "
            f"similarity from event {fits[0]} errs by at most {bias:.1%}, "
            f"within half of the tolerance {tolerance:.1%}",
        )
    why = "similarity errs by too much" if shot.volumes[0].anisotropy > 0 else "no lobe to reduce"
    return Resolved(
        method="reference",
        max_bounces=depth,
        reduce_from=shot.transport.reduce_from,
        noise=_noise(tolerance, cut),
        reason=f"{reach}: single scattering would leave out {measure.tail[1]:.1%}; "
        f"{why} for the tolerance {tolerance:.1%}",
    )


def _depth(measure: Measure, limit: float, earlier: Resolved | None) -> tuple[int | None, float]:
    """The fewest orders that leave out at most the limit, and what they leave out; None: all."""
    if earlier is not None and earlier.method != "single":
        kept = earlier.max_bounces
        if kept is not None and kept < PILOT_ORDERS and measure.tail[kept] <= limit * HYSTERESIS:
            return kept, float(measure.tail[kept])
        if kept is None and measure.tail[PILOT_ORDERS // 2] > limit / HYSTERESIS:
            return None, 0.0
    for orders in range(2, PILOT_ORDERS // 2 + 1):
        if measure.tail[orders] <= limit:
            return orders, float(measure.tail[orders])
    return None, 0.0


def _noise(tolerance: float, *shortfalls: float) -> float:
    """What is left for noise, with a margin for the scatter of its own estimate."""
    margin = 0.9
    left = tolerance**2 - sum(shortfall**2 for shortfall in shortfalls)
    return margin * math.sqrt(left)
