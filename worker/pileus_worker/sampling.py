"""Renders a frame, or a bucket of it, as it was decided: with a number of samples, or with as many
as each bucket's own error wants.

A bucket may err by as much of the frame's tolerance as it has of its opacity: where there is only
sky there is no noise, and the rest may have more. It knows nothing of the others, so that the farm
and `pileus render` take the same samples.
"""

import math
from collections.abc import Callable, Sequence

import pileus_core as core

from pileus_service.jobs import Bucket, Resolved
from pileus_service.shot import Shot
from pileus_worker import planning, scene

# Of the tolerance's square, what is shared out evenly, for noise that has nothing to do with
# opacity, as of a sky's texture at the pixels' edges. Where there is none, the frame's error is so
# much smaller.
EVEN = 0.1
# From a round that is too short to know, not too far.
GROWTH = 3
# What smoothing is said to leave has so many of the frame's standard errors on top: 95 % of frames
# are within.
MARGIN = 1.65
# The buckets whose rounds go together, for threads wait for each other after each.
TOGETHER = 64
Halves = list[core.Partial]  # one or two


class Sampler:
    """Renders one frame as it was decided, or parts of it."""

    def __init__(
        self,
        view: core.Scene,
        shot: Shot,
        resolved: Resolved,
        *,
        frame: int,
        threads: int,
        control: core.Control,
    ) -> None:
        self._view, self._shot, self._resolved = view, shot, resolved
        self._transport = scene.make_transport(shot, resolved)
        self._orders = (resolved.max_bounces or 0) if shot.image.orders else 0
        self._frame, self._threads, self._control = frame, threads, control

    def whole(self, done: Callable[[int], None] = lambda pixels: None) -> core.Frame:
        """All of the frame; `done` hears of the pixels that are finished."""
        size = (self._shot.image.width, self._shot.image.height)
        samples, adaptive = self._shot.sampling.samples, self._resolved.noise is not None
        buckets = planning.tiles(*size, planning.ADAPTIVE_EDGE if adaptive else max(size))
        frame = core.Frame(*size, [(each, None if adaptive else samples) for each in buckets])
        for first in range(0, len(buckets), TOGETHER):
            for part in self.parts(buckets[first : first + TOGETHER], (0, samples)):
                frame.add(part)
                x0, y0, x1, y1 = part.bucket
                done((x1 - x0) * (y1 - y0))
        return frame

    def parts(self, buckets: Sequence[Bucket], samples: tuple[int, int]) -> list[core.Partial]:
        """The buckets with all of the samples, or from 0 on with as many as their error wants.

        What is to be denoised grows as two independent halves: they tell what smoothing leaves of
        its error, which is what the denoiser is trusted with (docs/denoising.md)."""
        if self._resolved.noise is None:
            return self._render([(bucket, samples, 0) for bucket in buckets])
        count = 2 if self._shot.image.denoise and samples[1] > 1 else 1
        most = samples[1] // count
        growing = [[part] for part in self._render([(bucket, (0, 1), 0) for bucket in buckets])]
        unsure = growing
        if count == 2:
            # One sample may do, which then needs no other half.
            unsure = [halves for halves in growing if self._wanted(halves) > 1]
            first = [(halves[0].bucket, (0, 1), 1) for halves in unsure]
            for halves, other in zip(unsure, self._render(first), strict=True):
                halves.append(other)
        pending = self._pending(unsure, most)
        while pending:
            grown = [
                (half, wanted, number)
                for halves, wanted in pending
                for number, half in enumerate(halves)
            ]
            more = self._render(
                [(half.bucket, (half.samples[1], wanted), number) for half, wanted, number in grown]
            )
            for (half, *_), part in zip(grown, more, strict=True):
                half.pool(part)
            pending = self._pending([halves for halves, _ in pending], most)
        for whole, *rest in growing:
            for half in rest:
                whole.pool(half)
        return [halves[0] for halves in growing]

    def _pending(self, growing: Sequence[Halves], most: int) -> list[tuple[Halves, int]]:
        """Those that want more samples and may have them, and how many in all."""
        pending = []
        for halves in growing:
            wanted = self._wanted(halves)
            if wanted > _taken(halves) == most:
                halves[0].unmet = True
            elif wanted > _taken(halves):
                pending.append((halves, min(wanted, most)))
        return pending

    def _wanted(self, halves: Halves) -> int:
        """The samples that each should have, in all; no more than they have where those suffice."""
        assert self._resolved.noise is not None
        taken = _taken(halves)
        opacity = sum(half.opacity for half in halves) / len(halves)
        share = EVEN + (1 - EVEN) * opacity / self._resolved.opacity
        allowed = self._resolved.noise**2 * share
        wanted = math.inf
        if len(halves) == 2:
            half, other = halves
            error = core.smoothed_error(half, other, self._margin(half.bucket)) ** 2
            # As if all of it were noise. What smoothing blurs stays, and another round will tell.
            wanted = taken * error / allowed
        if wanted > taken:
            error = max(half.relative_error() for half in halves) ** 2 / len(halves)
            needed = error / allowed * taken
            # Few samples have met few of the rare bright paths and make too little of them: n count
            # as n / (1 + 1 / n).
            wanted = min(wanted, (needed + math.sqrt(needed * (needed + 4))) / 2)
        return math.ceil(min(wanted, GROWTH * taken))

    def _margin(self, bucket: Bucket) -> float:
        """How many of its own standard errors a bucket's smoothing has on top: the fewer the more
        buckets there are, whose errors even out over the frame; but no more than one."""
        x0, y0, x1, y1 = bucket
        share = (x1 - x0) * (y1 - y0) / (self._shot.image.width * self._shot.image.height)
        return min(1.0, MARGIN * math.sqrt(share))

    def _render(self, parts: list[tuple[Bucket, tuple[int, int], int]]) -> list[core.Partial]:
        """Each part a bucket, samples and the half that they are of."""
        seed = self._shot.sampling.seed
        return core.render_parts(
            self._view,
            self._transport,
            # No shot has a seed of so many bits.
            [(bucket, samples, seed + (half << 32)) for bucket, samples, half in parts],
            frame=self._frame,
            orders=self._orders,
            threads=self._threads,
            control=self._control,
        )


def _taken(halves: Halves) -> int:
    return halves[0].samples[1]
