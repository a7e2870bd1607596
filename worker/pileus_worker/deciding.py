"""Resolves a frame's transport: as the shot names it, or for `auto` by measuring the frame.

The error that `sampling.tolerance` allows is shared out: less than half of its square to what the
model leaves out, the rest to noise. A pilot image of a thousand pixels tells how much each order of
scattering brings; the model is then the smallest whose shortfall fits. Nothing rests on timings,
so every machine decides alike.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pileus_core as core
from numpy.typing import NDArray

from pileus_service.jobs import Resolved
from pileus_service.shot import Shot
from pileus_worker import scene

PILOT_PIXELS = 1024
FEWEST_PIXELS = 128
PILOT_SHARE = 0.0125  # of the pixel samples that the frame seems to need
DENOISED_SHARE = 0.0625  # of that share, where the frame is denoised and will take far fewer
PILOT_SAMPLES = 64  # of a pixel, at most
PILOT_ORDERS = 32
# Of the pilot's samples: `reference`, by which similarity's bias is told, takes its time.
BIAS_SHARE = 0.3
BLOCK = 4
# The RMS bias of `similarity` under a sun alone, by the event from which it reduces, as it usually
# is (docs/methods.md); under a plain sky alone it was never seen to be over SKY_BIAS.
SIMILARITY_BIAS = {2: 0.042, 3: 0.030, 6: 0.025}
SKY_BIAS = 0.005
MOST_BIAS = 0.6  # of the tolerance: about a third of its square
# So many standard errors must a bias that the pilot sees be over the usual one. With one, pilots of
# few samples saw one where there is none; more would hide one that is there.
CLEAR = 1.5
Planes = NDArray[np.float32]
# A decision stands along a sequence until the measure has left its limit by as much.
HYSTERESIS = 1.25


@dataclass(frozen=True)
class Measure:
    """What a pilot tells: the RMS relative error of leaving out the orders from N on, N = 0 .. 32
    (33 values, falling), of the look where it is greatest; the frame's mean opacity; and its noise
    with one sample a pixel."""

    tail: NDArray[np.float64]
    opacity: float = 1.0
    noise: float = math.inf


@dataclass(frozen=True)
class Seen:
    """A bias as a pilot sees it, relative, and the standard error of that."""

    bias: float
    error: float

    @property
    def least(self) -> float:
        return self.bias - CLEAR * self.error

    @property
    def most(self) -> float:
        return self.bias + CLEAR * self.error


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
    asked, opacity = shot.transport, 1.0
    if shot.sampling.tolerance is not None:
        pilot = Pilot(shot, frame, volume(), threads, control, reading)
        if asked.method == "auto":
            return decide(shot, pilot.measure(), pilot.bias, earlier)
        opacity = pilot.opacity()
    depth = "the depth" if asked.max_bounces else "the method's own depth"
    return Resolved(
        method=asked.method,
        max_bounces=core.Transport(
            method=asked.method, max_bounces=asked.max_bounces, looks=scene.make_looks(shot)
        ).max_bounces,
        reduce_from=asked.reduce_from,
        noise=shot.sampling.tolerance,
        opacity=opacity,
        reason=f"the shot names the method, with {depth}",
    )


class Pilot:
    """The frame rendered small, as two independent halves: the products of theirs have no noise in
    their mean."""

    def __init__(
        self,
        shot: Shot,
        frame: int,
        volume: core.Volume,
        threads: int,
        control: core.Control,
        reading: scene.Opener,
    ) -> None:
        image = shot.image
        pixels = image.width * image.height
        # Where the picture is itself small, each pixel of the pilot stands for forty of it: with
        # one sample a pixel its halves are then a twentieth of the frame's least.
        wanted = min(max(FEWEST_PIXELS, pixels / 40), PILOT_PIXELS)
        shrink = math.sqrt(min(1.0, wanted / pixels))
        width, height = max(1, round(image.width * shrink)), max(1, round(image.height * shrink))
        small = shot.model_copy(
            update={"image": image.model_copy(update={"width": width, "height": height})}
        )
        self._shot, self._frame, self._threads, self._control = shot, frame, threads, control
        self._size = (width, height)
        # Of the frame's samples a pixel, for each of two halves.
        self._share = PILOT_SHARE * pixels / (2 * width * height)
        if image.denoise:
            self._share *= DENOISED_SHARE
        self._scene = scene.make_scene(small, frame, volume, reading)
        self._bias_samples = 0

    def opacity(self) -> float:
        return _opacity(self._halves((0, 1)))

    def measure(self) -> Measure:
        """From as many samples as the noise of the first one is worth."""
        sampling = self._shot.sampling
        assert sampling.tolerance is not None  # the shot's own check
        halves = self._halves((0, 1))
        noise = [half.relative_error() for half in halves]
        wanted = min((max(noise) / sampling.tolerance) ** 2, sampling.samples)
        samples = int(min(max(1.0, self._share * wanted), PILOT_SAMPLES))
        # Less than one would cost the frame more than its share, and tell nothing.
        self._bias_samples = int(min(BIAS_SHARE * self._share * wanted, PILOT_SAMPLES))
        if samples > 1:
            for half, further in zip(halves, self._halves((1, samples)), strict=True):
                half.pool(further)
        layers = np.stack([_planes(half) for half in halves])
        tails = [_tail(layers[:, look]) for look in range(layers.shape[1])]
        if any(half.bounded_paths for half in halves):
            tails.append(np.ones(PILOT_ORDERS + 1))  # of what was cut off nothing is known
        return Measure(np.max(tails, axis=0), _opacity(halves), sum(noise) / 2)

    def bias(self, start: int) -> Seen:
        """How far `similarity` from an event on errs: what all pixels of the volume have in common,
        as an RMS relative error of the frame, of the look where it is greatest. It has the random
        numbers of the truth, so that only what differs is noise."""
        if self._bias_samples == 0:
            return Seen(0.0, 0.0)
        truth = self._truth
        ours = self._pair("similarity", (0, self._bias_samples), start)
        differ = np.stack([_wholes(a) - _wholes(b) for a, b in zip(ours, truth, strict=True)])
        differ = differ.mean(axis=2)  # over RGB: of shape (halves, looks, pixels)
        unlike = (differ[0] - differ[1]) / 2
        error = np.sqrt((unlike**2).mean(-1) / unlike.shape[-1])
        common = np.abs(differ.mean(axis=(0, 2)))
        opacity = np.mean([half.pixels(half.looks[0])[..., 3].ravel() for half in truth], axis=0)
        if not opacity.any():
            return Seen(0.0, 0.0)
        bright = np.mean([_wholes(half).mean(axis=1) @ opacity for half in truth], axis=0)
        scale = np.sqrt(opacity.mean() * ((bright / opacity.sum()) ** 2 + 0.01))
        worst = int(np.argmax(common / scale))
        return Seen(float(common[worst] / scale[worst]), float(error[worst] / scale[worst]))

    @cached_property
    def _truth(self) -> tuple[core.Partial, core.Partial]:
        return self._pair("reference", (0, self._bias_samples))

    def _halves(self, samples: tuple[int, int]) -> tuple[core.Partial, core.Partial]:
        """With each order of scattering for itself, and what comes after the last one."""
        return self._pair("similarity", samples, orders=PILOT_ORDERS + 1)

    def _pair(
        self, method: str, samples: tuple[int, int], reduce_from: int = 3, orders: int = 0
    ) -> tuple[core.Partial, core.Partial]:
        looks = scene.make_looks(self._shot)
        transport = core.Transport(method=method, looks=looks, reduce_from=reduce_from)

        def half(number: int) -> core.Partial:
            return core.render(
                self._scene,
                transport,
                bucket=(0, 0, *self._size),
                samples=samples,
                seed=self._shot.sampling.seed + number,
                frame=self._frame,
                orders=orders,
                threads=self._threads,
                control=self._control,
            )

        return half(1), half(2)


def _opacity(halves: tuple[core.Partial, core.Partial]) -> float:
    """The mean opacity of a frame, and no less than tells a bucket from another."""
    return max(0.001, sum(half.opacity for half in halves) / 2)


def _wholes(half: core.Partial) -> Planes:
    """The pixels of all looks, of shape (looks, 3, pixels)."""
    return np.stack([half.pixels(look)[..., :3].reshape(-1, 3).T for look in half.looks])


def _planes(half: core.Partial) -> Planes:
    """The orders and the whole, of shape (looks, orders + 1, 3, rows, columns)."""
    orders = np.stack([half.orders(look) for look in half.looks])
    wholes = _wholes(half).reshape(len(orders), 1, *orders.shape[2:])
    return np.concatenate([orders, wholes], axis=1)


def _tail(layers: Planes) -> NDArray[np.float64]:
    """What the orders from N on bring, N = 0 .. 32, from two halves, in blocks of pixels; and two
    standard errors more. Few paths may all end early; but light falls from order to order ever more
    slowly, so none is taken to leave less than the first two let expect."""
    blocks = _blocks(layers)
    rests = np.cumsum(blocks[:, -2::-1], axis=1)[:, ::-1]
    level = blocks[:, -1].mean(axis=(0, 1))
    products = np.mean(rests[0] * rests[1], axis=1) / (level**2 + 0.01)
    upper = products.mean((1, 2)) + 2 * products.std((1, 2)) / math.sqrt(level.size)
    falling = np.maximum(np.maximum.accumulate(upper[::-1])[::-1], 0.0)
    if falling[2] > 0:
        further = np.arange(len(falling) - 2)
        falling[2:] = np.maximum(falling[2:], falling[2] * (falling[2] / falling[1]) ** further)
    return np.asarray(np.sqrt(falling))


def _blocks(planes: Planes) -> NDArray[np.float64]:
    """The means of blocks of pixels, the last two axes; those at the far edges are smaller."""
    values = planes.astype(np.float64)
    for _ in range(2):  # along the rows, then along the columns
        sums = values[..., ::BLOCK].copy()
        for place in range(1, BLOCK):
            further = values[..., place::BLOCK]
            sums[..., : further.shape[-1]] += further
        edges = [*range(0, values.shape[-1], BLOCK), values.shape[-1]]
        values = (sums / np.diff(edges)).swapaxes(-1, -2)
    return values


def decide(
    shot: Shot,
    measure: Measure,
    bias_from: Callable[[int], Seen],
    earlier: Resolved | None = None,
) -> Resolved:
    """The smallest model whose shortfalls leave more than half of the tolerance's square.
    `bias_from` tells how far `similarity` from an event on errs, and takes its time."""
    tolerance = shot.sampling.tolerance
    assert tolerance is not None  # the shot's own check
    limits = np.full(PILOT_ORDERS, tolerance / 8)
    # Single scattering has no other shortfall, and no frame takes less than a sample a pixel: it
    # may have half of what the noise of one leaves.
    limits[1] = max(limits[1], (tolerance - measure.noise) / 2)
    depth, cut = _depth(measure, limits, earlier)
    if shot.transport.max_bounces is not None and (
        depth is None or shot.transport.max_bounces < depth
    ):
        depth, cut = shot.transport.max_bounces, 0.0  # the shot's own wish is no error
    share = _sun_share(shot)
    biases = {start: max(SKY_BIAS, share * bias) for start, bias in SIMILARITY_BIAS.items()}
    bias, reduce_from = 0.0, shot.transport.reduce_from
    if depth == 1:
        method, why = "reference", "nothing to reduce"
    elif shot.volumes[0].anisotropy <= 0:
        method, why = "reference", "no lobe to reduce"
    else:
        method, why = "reference", "similarity errs by too much"
        for start, usual in biases.items():
            if usual > MOST_BIAS * tolerance:
                continue
            # Where the orders that it changes bring less than that, there is nothing to look for.
            seen = bias_from(start) if measure.tail[start] > usual else Seen(0.0, 0.0)
            if _serves(start, seen, usual, MOST_BIAS * tolerance, earlier):
                method, reduce_from, bias = "similarity", start, max(usual, seen.least)
                why = f"similarity from event {start} errs by about {bias:.1%}"
                break
    reach = {None: "all orders", 1: "single scattering"}.get(depth, f"{depth} orders")
    without = "" if depth == 1 else f"; single scattering would leave out {measure.tail[1]:.1%}"
    return Resolved(
        method=method,
        max_bounces=depth,
        reduce_from=reduce_from,
        # Both shortfalls are light that is missing: they add up.
        noise=math.sqrt(tolerance**2 - (cut + bias) ** 2),
        opacity=measure.opacity,
        reason=f"{reach}, which leaves out {cut:.1%}{without}; {why}, "
        f"for the tolerance {tolerance:.1%}{' once denoised' if shot.image.denoise else ''}",
    )


def _serves(start: int, seen: Seen, usual: float, most: float, earlier: Resolved | None) -> bool:
    """Whether `similarity` from an event on may serve: unless the pilot sees that it errs by more
    than is usual, and by too much. What was passed over for the sequence's first frame must be seen
    to err by less."""
    margin = 1.0
    if earlier is not None and earlier.max_bounces != 1:
        if earlier.method != "similarity" or earlier.reduce_from > start:
            return seen.most <= most / HYSTERESIS
        margin = HYSTERESIS
    return seen.least <= margin * usual or seen.bias <= margin * most


def _sun_share(shot: Shot) -> float:
    """What of the light that a point in the open gets is suns'. A textured sky may hold one."""
    suns = sum(max(light.irradiance) for light in shot.lights if light.type == "distant")
    skies = [light for light in shot.lights if light.type == "dome"]
    suns += sum(math.inf for sky in skies if sky.texture is not None)
    sky = sum(4 * math.pi * min(sky.radiance) for sky in skies)
    return 1.0 if math.isinf(suns) or suns + sky == 0 else suns / (suns + sky)


def _depth(
    measure: Measure, limits: NDArray[np.float64], earlier: Resolved | None
) -> tuple[int | None, float]:
    """The fewest orders that leave out at most their limit, and what they leave out; None: all."""
    tail, most = measure.tail, PILOT_ORDERS // 2
    if earlier is not None:
        kept = earlier.max_bounces
        if kept is not None and kept < PILOT_ORDERS and tail[kept] <= limits[kept] * HYSTERESIS:
            return kept, float(tail[kept])
        if kept is None and tail[most] > limits[most] / HYSTERESIS:
            return None, 0.0
    for orders in range(1, most + 1):
        if tail[orders] <= limits[orders]:
            return orders, float(tail[orders])
    return None, 0.0
