"""Small caches of each kind that a reader may meet, written by OpenVDB's own Python module, which
Debian's Python has and ours has not: `/usr/bin/python3 odd_caches.py FOLDER`."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyopenvdb as vdb


def ball(**settings: bool) -> Any:
    grid = vdb.FloatGrid()
    grid.name = "density"
    for name, value in settings.items():
        setattr(grid, name, value)
    place = np.indices((20, 20, 20)) - 10
    grid.copyFromArray(np.maximum(0.0, 1.0 - np.sqrt((place**2).sum(0)) / 5.0), ijk=(-10, -10, -10))
    return grid


def tiles() -> Any:
    """Constant regions at both of the tree's inner levels."""
    grid = ball()
    grid.fill((64, 0, 0), (127, 63, 63), 0.5)
    grid.fill((-4096, 0, 0), (-3841, 127, 127), 0.25)
    return grid


def odd_values() -> Any:
    grid = ball()
    voxels = grid.getAccessor()
    for x, value in enumerate((float("nan"), float("inf"), -2.0)):
        voxels.setValueOn((x, 0, 0), value)
    return grid


def level_set() -> Any:
    grid = vdb.createLevelSetSphere(4.0, voxelSize=1.0, halfWidth=2.0)
    grid.name = "density"
    return grid


def frustum() -> Any:
    grid = ball()
    grid.transform = vdb.createFrustumTransform((0, 0, 0), (10, 10, 10), 0.5, 10.0)
    return grid


def vectors() -> Any:
    grid = vdb.Vec3SGrid()
    grid.name = "density"
    grid.fill((0, 0, 0), (7, 7, 7), (1.0, 2.0, 3.0))
    return grid


def twins() -> list[Any]:
    """Two grids that share their voxels."""
    first = ball()
    second = first.copy()
    second.name = "twin"
    return [second, first]


folder = Path(sys.argv[1])
caches = {
    "half": ball(saveFloatAsHalf=True),
    "tiles": tiles(),
    "odd_values": odd_values(),
    "level_set": level_set(),
    "frustum": frustum(),
    "vectors": vectors(),
    "twins": twins(),
}
for name, grids in caches.items():
    vdb.write(str(folder / f"{name}.vdb"), grids)
