"""What Prometheus reads: the queue's depth, the farm's counters, its workers."""

from collections.abc import Iterator

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from pileus_service.queue import Queue

_COUNTERS = {
    "tasks_done": "Tasks completed",
    "frames_done": "Frames finished",
    "frames_failed": "Frames given up",
    "attempts_failed": "Attempts that failed, lost leases included",
    "leases_lost": "Leases that ran out because a worker stopped answering",
    "tasks_parked": "Tasks given up after their last attempt",
    "samples": "Pixel samples rendered",
}


class _FarmCollector(Collector):
    def __init__(self, queue: Queue) -> None:
        self._queue = queue

    def collect(self) -> Iterator[CounterMetricFamily | GaugeMetricFamily]:
        stats = self._queue.stats()
        for name, text in _COUNTERS.items():
            yield CounterMetricFamily(f"pileus_{name}", text, value=stats.get(name, 0))
        waiting = GaugeMetricFamily("pileus_tasks_waiting", "Tasks queued", labels=["priority"])
        held = GaugeMetricFamily("pileus_tasks_held", "Tasks under lease", labels=["priority"])
        for priority, (queued, leased) in self._queue.depths().items():
            waiting.add_metric([str(priority)], queued)
            held.add_metric([str(priority)], leased)
        yield waiting
        yield held
        alive = sum(worker.alive for worker in self._queue.workers())
        yield GaugeMetricFamily("pileus_workers", "Workers alive", value=alive)


def exposition(queue: Queue) -> bytes:
    registry = CollectorRegistry()
    registry.register(_FarmCollector(queue))
    return generate_latest(registry)
