"""What the fault tests share: caches, a shot over them, and faults to be loaded into a process."""

import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pileus_core as core
import pytest

from pileus_service.shot import Shot


@pytest.fixture(scope="session")
def faults(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The library faults.c, for LD_PRELOAD."""
    library = tmp_path_factory.mktemp("faults") / "faults.so"
    source = Path(__file__).with_name("faults.c")
    subprocess.run(["gcc", "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True)
    return library


@pytest.fixture
def tmp_path(tmp_path: Path) -> Iterator[Path]:
    """In memory where that can be: a killed process loses nothing there that a disk would keep,
    and thousands of small files that are each synced take no minutes."""
    memory = Path("/dev/shm")
    if not memory.is_dir():
        yield tmp_path
        return
    with tempfile.TemporaryDirectory(dir=memory, prefix="chaos-") as folder:
        yield Path(folder)


@pytest.fixture
def cached_shot(shot: dict[str, Any], tmp_path: Path) -> Shot:
    """Three frames with caches of their own, a few tasks each where tasks are planned short."""
    (tmp_path / "caches").mkdir()
    for frame in (1, 2, 3):
        path = tmp_path / "caches" / f"cloud.{frame:04d}.vdb"
        core.make_cloud(str(path), frame=frame, frames=3, resolution=32)
    shot["image"] |= {"width": 64, "height": 64}
    shot["sampling"]["samples"] = 16
    shot["transport"] = {"method": "single"}
    return Shot.model_validate(shot)
