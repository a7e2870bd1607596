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
GROWTH = 4
# The buckets whose rounds go together, for threads wait for each other after each.
TOGETHER = 64


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
        self.unmet = 0  # buckets that have had all samples and want more

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
        """The buckets with all of the samples, or from 0 on with as many as their error wants."""
        if self._resolved.noise is None:
            return self._render([(bucket, samples) for bucket in buckets])
        parts = self._render([(bucket, (0, 1)) for bucket in buckets])
        pending = self._pending(parts, samples[1])
        while pending:
            ranges = [(part.bucket, (part.samples[1], wanted)) for part, wanted in pending]
            for (part, _), more in zip(pending, self._render(ranges), strict=True):
                part.pool(more)
            pending = self._pending([part for part, _ in pending], samples[1])
        return parts

    def _pending(self, parts: Sequence[core.Partial], most: int) -> list[tuple[core.Partial, int]]:
        """Those that want more samples and may have them, and how many in all."""
        pending = []
        for part in parts:
            taken, wanted = part.samples[1], self._wanted(part)
            if wanted > taken == most:
                self.unmet += 1
            elif wanted > taken:
                pending.append((part, min(wanted, most)))
        return pending

    def _wanted(self, part: core.Partial) -> int:
        """The samples that a part should have in all; no more than it has where those suffice."""
        assert self._resolved.noise is not None
        taken = part.samples[1]
        share = EVEN + (1 - EVEN) * part.opacity / self._resolved.opacity
        needed = (part.relative_error() / self._resolved.noise) ** 2 / share * taken
        # Few samples have met few of the rare bright paths and make too little of them: n count as
        # n / (1 + 1 / n).
        wanted = (needed + math.sqrt(needed * (needed + 4))) / 2
        return math.ceil(min(wanted, GROWTH * taken))

    def _render(self, parts: list[tuple[Bucket, tuple[int, int]]]) -> list[core.Partial]:
        return core.render_parts(
            self._view,
            self._transport,
            parts,
            seed=self._shot.sampling.seed,
            frame=self._frame,
            orders=self._orders,
            threads=self._threads,
            control=self._control,
        )
