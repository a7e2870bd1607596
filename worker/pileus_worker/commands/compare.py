"""`pileus compare`: how far an image is from a reference."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pileus_core as core
import typer
from numpy.typing import NDArray

from pileus_service.errors import InputError
from pileus_service.options import AsJson
from pileus_worker.errors import plain_errors
from pileus_worker.pictures import to_display, write_png

app = typer.Typer()


@dataclass(frozen=True)
class Comparison:
    """Over pixels and RGB; relMSE is the mean of (x - r)^2 / (r^2 + 0.01)."""

    rel_mse: float
    mean_ratio: float
    largest_error: float


def compared(image: NDArray[np.float64], reference: NDArray[np.float64]) -> Comparison:
    error = image - reference
    return Comparison(
        rel_mse=float(np.mean(error**2 / (reference**2 + 0.01))),
        mean_ratio=float(image.mean() / reference.mean()) if reference.any() else float("nan"),
        largest_error=float(np.abs(error).max()),
    )


def read_rgb(path: Path, look: str | None) -> NDArray[np.float64]:
    """The RGB of a look (the first, where none is named), as (height, width, 3)."""
    with plain_errors(str(path)):
        parts = core.read_image(str(path))
    name = look if look is not None and len(parts) > 1 else next(iter(parts))
    if name not in parts:
        raise InputError(f"{path}: has no look {name!r}; it has {', '.join(parts)}")
    missing = [channel for channel in "RGB" if channel not in parts[name]]
    if missing:
        raise InputError(f"{path}: has no channel {', '.join(missing)}; give an RGB image")
    return np.stack([parts[name][channel] for channel in "RGB"], axis=-1).astype(np.float64)


@app.command("compare")
def compare(
    image: Annotated[Path, typer.Argument(metavar="IMAGE")],
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE")],
    look: Annotated[str | None, typer.Option(help="The look, where there are several.")] = None,
    difference: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Writes |image - reference| here.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compares two images: relMSE, mean ratio, largest error."""
    x, r = read_rgb(image, look), read_rgb(reference, look)
    if x.shape != r.shape:
        (h, w), (rh, rw) = x.shape[:2], r.shape[:2]
        raise InputError(f"{image} is {w}x{h} and {reference} is {rw}x{rh}; compare equal sizes")
    result = compared(x, r)
    if difference is not None:
        if difference.suffix.lower() != ".png":
            raise InputError(f"--difference {difference}: must end in .png")
        with plain_errors(str(difference)):
            write_png(difference, to_display(np.abs(x - r).astype(np.float32)))
    if as_json:
        print(json.dumps(asdict(result)))
    else:
        print(
            f"relMSE {result.rel_mse:.4g}, mean ratio {result.mean_ratio:.6f}, "
            f"largest error {result.largest_error:.4g}"
        )
