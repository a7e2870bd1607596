"""What the tests share: a real Redis for each test process, a shot to vary."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from redis import Redis

from pileus_service.farm import Farm
from pileus_service.queue import Queue, connect
from pileus_service.roots import Roots
from pileus_service.store import Store
from pileus_worker.private_redis import PrivateRedis
from queueing import LEASE


@pytest.fixture(scope="session")
def private_redis(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PrivateRedis]:
    with PrivateRedis(tmp_path_factory.mktemp("redis")) as server:
        yield server


@pytest.fixture(scope="session")
def redis_url(private_redis: PrivateRedis) -> str:
    """For the farm's own user, who may do what the farm does and no more."""
    return private_redis.farm_url


@pytest.fixture
def redis(private_redis: PrivateRedis) -> Iterator[Redis]:
    with connect(private_redis.url) as client:
        client.flushall()
        yield client


@pytest.fixture
def queue(redis: Redis) -> Queue:
    return Queue(redis, lease=LEASE)


@pytest.fixture
def shot(tmp_path: Path) -> dict[str, Any]:
    """A small right shot whose cache does not exist yet."""
    return {
        "name": "test",
        "frames": "1-3",
        "image": {"width": 48, "height": 32, "output": str(tmp_path / "out" / "test.####.exr")},
        "volumes": [
            {
                "cache": str(tmp_path / "caches" / "cloud.####.vdb"),
                "extinction": 20.0,
                "anisotropy": 0.5,
            }
        ],
        "camera": {"position": [0.15, 0.12, 1.9], "look_at": [0.0, 0.02, 0.0], "fov": 35.0},
        "lights": [
            {"type": "distant", "direction": [0.6, -0.55, -0.58], "irradiance": [3.0, 3.0, 3.0]},
            {"type": "dome", "radiance": [0.3, 0.35, 0.4]},
        ],
        "transport": {"method": "multiple", "max_bounces": 4},
        "sampling": {"samples": 4, "seed": 7},
    }


@pytest.fixture
def farm(redis: Redis, tmp_path: Path, shot: dict[str, Any]) -> Farm:
    """The service's farm without workers; the shot's caches are there, empty."""
    (tmp_path / "caches").mkdir()
    for frame in (1, 2, 3):
        (tmp_path / "caches" / f"cloud.{frame:04d}.vdb").touch()
    return Farm(Store(tmp_path / "data"), Queue(redis), Roots([tmp_path]))
