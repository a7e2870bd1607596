"""Denoises a whole frame, look by look, with Intel's Open Image Denoise (OIDN).

The one guide image is made of the frame's own opacity: it tells the filter where the volume ends.
What other guides bring to volumes, and what they cost, is measured in docs/denoising.md.
"""

from collections.abc import Callable, Iterable
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np
import pileus_core as core
from numpy.typing import NDArray

from pileus_service.errors import FarmError, InputError
from pileus_service.shot import Sampling, Shot

Pixels = NDArray[np.float32]
Quality = Literal["FAST", "HIGH"]  # as OIDN calls its networks; BALANCED is HIGH on a CPU
FEW_SAMPLES = 4
LOOSE_TOLERANCE = 0.04  # which few samples meet, once they are denoised
# OIDN fills what it is given up to whole squares of so many pixels with black, and draws some of it
# in. So it is given a margin: the image's own pixels, and where there are none its mirror.
SQUARE = 16
MARGIN = 4  # at least, on each side
ONE_COLOUR = 1e-4  # relative: what adding up samples rounds


def check_installed(shot: Shot, source: str) -> None:
    """Refuses a shot that wants denoising where OIDN is missing, before anything is rendered."""
    if shot.image.denoise and find_spec("pyoidn") is None:
        raise InputError(
            f"{source}: image.denoise: needs Open Image Denoise, which is not installed; "
            "pip install 'pileus[denoise]', or set it to false"
        )


def denoise(
    frame: core.Frame, shot: Shot, threads: int, done: Callable[[], None] = lambda: None
) -> None:
    """Puts denoised colours into a frame that is complete, where the shot wants them; `done` hears
    of each look that is through."""
    if not shot.image.denoise:
        return
    filter_, quality = Filter(threads), quality_of(shot.sampling)
    names = [look.name for look in shot.transport.looks]
    guide = guide_of(frame.pixels(names[0])[..., 3])
    filtered = []
    for name in names:
        filtered.append(filter_({"color": frame.pixels(name), "albedo": guide}, quality))
        done()
    frame.set_denoised(filtered)


def quality_of(sampling: Sampling) -> Quality:
    """The network for a shot's frames. HIGH costs about a sample a pixel more than FAST: where
    there are few, that sample would take away more of the error than HIGH does. The shot alone
    decides, so that no sequence changes its network on the way."""
    few = sampling.samples <= FEW_SAMPLES
    loose = sampling.tolerance is not None and sampling.tolerance >= LOOSE_TOLERANCE
    return "FAST" if few or loose else "HIGH"


class Filter:
    """OIDN's filter for rendered images, on so many threads."""

    def __init__(self, threads: int) -> None:
        import pyoidn  # optional, and slow to load

        self._oidn = pyoidn
        self._device = pyoidn.Device(pyoidn.OIDN_DEVICE_TYPE_CPU)
        self._device.set_int("numThreads", threads)
        # Other workers share the machine: the system knows better where threads belong.
        self._device.set_bool("setAffinity", False)
        self._device.commit()
        self._check()

    def __call__(self, images: dict[str, Pixels], quality: Quality) -> Pixels:
        """Filters a linear `color` of any range with the guides `albedo` and `normal`, or a guide
        alone. All are of shape (height, width, 3 or more) and their first three channels count;
        returns (height, width, 3). Raises FarmError."""
        [alone, *_] = images.values()
        filtered: Pixels = images.get("color", alone)[..., :3].copy()
        part = _uneven(images.values())
        if all(side.start < side.stop for side in part):
            margins = [_margins(side) for side in part]
            seen = {name: _widened(image, part, margins) for name, image in images.items()}
            (top, _), (left, _) = margins
            height, width = (side.stop - side.start for side in part)
            out = self._run(seen, quality)
            filtered[part] = out[top : top + height, left : left + width]
        return filtered

    def _run(self, images: dict[str, Pixels], quality: Quality) -> Pixels:
        oidn = self._oidn
        output = np.empty((*next(iter(images.values())).shape[:2], 3), np.float32)
        with oidn.Filter(self._device, oidn.OIDN_FILTER_TYPE_RT) as rt:
            for name, image in {**images, "output": output}.items():
                stride = image.shape[2] * image.itemsize
                rt.set_image(name, image, oidn.OIDN_FORMAT_FLOAT3, pixel_byte_stride=stride)
            if "color" in images:
                rt.set_bool("hdr", True)
            rt.set_quality(getattr(oidn, f"OIDN_QUALITY_{quality}"))
            rt.commit()
            rt.execute()
            self._check()
        return output

    def _check(self) -> None:
        error: Any = self._device.get_error()
        if error is not None:
            raise FarmError(f"image.denoise: Open Image Denoise fails: {error}")


def _uneven(images: Iterable[Pixels]) -> tuple[slice, slice]:
    """The rows and columns outside of which each image is all of one colour: a plain sky, or
    nothing. There is no noise to filter."""
    differ = [np.abs(image - image[0, 0]) > ONE_COLOUR * np.abs(image[0, 0]) for image in images]
    by_row = [each.reshape(len(each), -1).any(axis=1) for each in differ]
    by_column = [each.any(axis=0).any(axis=1) for each in differ]
    rows, columns = (np.flatnonzero(np.any(each, axis=0)) for each in (by_row, by_column))
    if not rows.size:
        return slice(0, 0), slice(0, 0)
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _margins(side: slice) -> tuple[int, int]:
    """Before and behind a part, so that it has whole squares."""
    length = side.stop - side.start
    spare = -(length + 2 * MARGIN) % SQUARE
    return MARGIN + spare // 2, MARGIN + spare - spare // 2


def _widened(image: Pixels, part: tuple[slice, slice], margins: list[tuple[int, int]]) -> Pixels:
    """A part of an image with margins; beyond the image they are its mirror."""
    mirrored = np.pad(image, ((SQUARE, SQUARE), (SQUARE, SQUARE), (0, 0)), "symmetric")
    rows, columns = (
        slice(SQUARE + side.start - before, SQUARE + side.stop + behind)
        for side, (before, behind) in zip(part, margins, strict=True)
    )
    return np.ascontiguousarray(mirrored[rows, columns])


def guide_of(opacity: Pixels) -> Pixels:
    """What stands for an albedo, of shape (height, width, 3): white where the opacity (height,
    width) is 1, mid-grey where it is 0. The noise that single hits and misses give it is evened
    out over neighbours with the weights 1, 2, 1."""
    for axis in (0, 1):
        edges = [(1, 1) if axis == each else (0, 0) for each in (0, 1)]
        padded = np.pad(opacity, edges, "edge")
        before, here, after = (
            np.take(padded, range(i, i + opacity.shape[axis]), axis) for i in range(3)
        )
        opacity = np.asarray((before + 2 * here + after) / 4, np.float32)
    return np.repeat((opacity[..., np.newaxis] + 1) / 2, 3, axis=-1)
