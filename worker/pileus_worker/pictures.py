"""Display pictures of linear images: previews, contact sheets, labelled strips."""

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont
from PIL.Image import Image, Resampling

from pileus_service.store import write_whole

Pixels = NDArray[np.floating[Any]]
PREVIEW_EDGE = 640
BACKGROUND = (18, 18, 20)
INK = (225, 225, 225)

__all__ = ["Image", "contact_sheet", "strip", "to_display", "write_png", "write_preview"]


def to_display(linear: Pixels, exposure: float = 0.0) -> Image:
    """Linear RGB(A) as sRGB, so many stops brighter; what is over white is clipped."""
    rgb = np.nan_to_num(linear[..., :3]) * 2.0**exposure
    rgb = np.clip(rgb, 0.0, 1.0)
    encoded = np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * rgb ** (1 / 2.4) - 0.055)
    return Pillow.fromarray((encoded * 255 + 0.5).astype(np.uint8))


def write_preview(path: Path, linear: Pixels) -> None:
    """A small PNG, whole or not at all."""
    picture = to_display(linear)
    picture.thumbnail((PREVIEW_EDGE, PREVIEW_EDGE))
    write_png(path, picture)


def write_png(path: Path, picture: Image) -> None:
    data = io.BytesIO()
    picture.save(data, "PNG")
    write_whole(path, data.getvalue())


def contact_sheet(pictures: Sequence[Image], columns: int = 6, edge: int = 320) -> Image:
    """All pictures of a shot in reading order."""
    gap = 4
    columns = min(columns, len(pictures))
    width, height = pictures[0].size
    size = (edge, max(1, round(edge * height / width)))
    rows = math.ceil(len(pictures) / columns)
    sheet = Pillow.new(
        "RGB", (columns * (size[0] + gap) + gap, rows * (size[1] + gap) + gap), BACKGROUND
    )
    for index, picture in enumerate(pictures):
        row, column = divmod(index, columns)
        place = (gap + column * (size[0] + gap), gap + row * (size[1] + gap))
        sheet.paste(picture.resize(size, Resampling.LANCZOS), place)
    return sheet


def strip(panels: Sequence[tuple[str, Image]]) -> Image:
    """Pictures side by side, each over its label."""
    gap, label = 8, 36
    width, height = panels[0][1].size
    sheet = Pillow.new(
        "RGB", (len(panels) * (width + gap) + gap, height + 2 * gap + label), BACKGROUND
    )
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(18)
    for index, (text, picture) in enumerate(panels):
        x = gap + index * (width + gap)
        sheet.paste(picture, (x, gap))
        draw.text((x + width / 2, gap + height + label / 2), text, INK, font, anchor="mm")
    return sheet
