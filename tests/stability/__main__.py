"""Writes docs/stability.md: `make stability`."""

import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path

from stability.battery import FULL, METHODS, Cell, Estimate, Stage, bounces, run
from stability.hazards import HAZARDS, Hazard

PAGE = Path(__file__).resolve().parents[2] / "docs" / "stability.md"
HEAD = Path(__file__).with_name("page.md")

Row = dict[str, Cell]  # by method


def row(hazard: Hazard) -> Row:
    with tempfile.TemporaryDirectory() as folder:
        stage = Stage.of(hazard, Path(folder), FULL)
        truth = cache(stage.truth)
        cells = {}
        for method in METHODS:
            cell = run(stage, method)
            # The contrast approximation stands for every order.
            orders = None if method == "contrast" else bounces(method)
            cells[method] = replace(cell, truth=truth(orders))
            print(f"{hazard.name}: {method}", file=sys.stderr)
        return cells


def bias(cell: Cell) -> str:
    """The gap of the means in percent, plus or minus one standard error."""
    truth = cell.truth or Estimate(0.0, 0.0)
    if truth.mean == 0.0:
        return "-"
    gap = cell.picture.mean / truth.mean - 1
    error = (cell.picture.error**2 + truth.error**2) ** 0.5 / truth.mean
    return f"{number(100 * gap, sign=True)} ± {number(100 * error)}"


def cost(cell: Cell) -> str:
    told = f"{number(cell.sigma)} · {number(cell.microseconds)}"
    return f"{told} · {cell.bounded:,}" if cell.bounded else told


def furnace(cell: Cell) -> str:
    return f"{cell.furnace.mean:.4g}"


def number(value: float, sign: bool = False) -> str:
    """Two digits, as a person would write them."""
    digits = f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}"
    text = f"{float(digits):,.10f}".rstrip("0").rstrip(".")
    return f"+{text}" if sign and value > 0 else text


def table(rows: dict[str, Row], tell: Callable[[Cell], str]) -> Iterable[str]:
    yield "| hazard | " + " | ".join(f"`{method}`" for method in METHODS) + " |"
    yield "|---" * (len(METHODS) + 1) + "|"
    for name, cells in rows.items():
        yield f"| {name} | " + " | ".join(tell(cells[m]) for m in METHODS) + " |"


def held(rows: dict[str, Row]) -> Iterable[str]:
    broken = [
        f"- {name}, `{method}`: {'; '.join(cell.broken)}"
        for name, cells in rows.items()
        for method, cell in cells.items()
        if cell.broken
    ]
    count = sum(len(cells) for cells in rows.values())
    if not broken:
        yield f"Every guard held in all {count} cells."
        return
    yield f"Guards did not hold in {len(broken)} of {count} cells:"
    yield ""
    yield from broken


def main() -> None:
    rows = {hazard.name: row(hazard) for hazard in HAZARDS}
    hazards = ["| hazard | what it is |", "|---|---|"]
    hazards += [f"| {hazard.name} | {hazard.what} |" for hazard in HAZARDS]
    parts = {
        "hazards": hazards,
        "held": held(rows),
        "bias": table(rows, bias),
        "cost": table(rows, cost),
        "furnace": table(rows, furnace),
    }
    text = HEAD.read_text()
    for name, lines in parts.items():
        text = text.replace(f"<!-- {name} -->", "\n".join(lines))
    PAGE.write_text(text)


main()
