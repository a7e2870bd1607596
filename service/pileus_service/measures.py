"""What workers measure of their attempts, added up in Redis: counters that Prometheus reads.

They are for people who watch, not for the farm: one that is lost or told twice changes no pixel.
A field of the hash is a counter's name and its labels' values, parted by spaces.
"""

from collections.abc import Mapping
from typing import cast

from redis import Redis

_KEY = "pileus:measures"


class Measures:
    """The counters of one farm."""

    def __init__(self, redis: "Redis") -> None:
        self._redis = redis

    def add(self, amounts: Mapping[str, float]) -> None:
        """Adds to counters, in one round trip."""
        redis = self._redis.pipeline(transaction=False)
        for field, amount in amounts.items():
            redis.hincrbyfloat(_KEY, field, amount)
        redis.execute()

    def read(self) -> dict[tuple[str, ...], float]:
        """Each counter's value, by its name and its labels' values."""
        held = cast(dict[str, str], self._redis.hgetall(_KEY))
        return {tuple(field.split()): float(value) for field, value in held.items()}
