"""What Prometheus reads: the queue by priority, attempts and what they took, frames, workers.

The counters live in Redis, so every service of a farm tells the same; scrape one of them.
"""

from collections.abc import Iterator, Mapping

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from pileus_service.jobs import Cause, JobState, Kind
from pileus_service.measures import Measures
from pileus_service.queue import DRAINED, Queue

_COUNTED = {
    "tasks_done": "Tasks completed",
    "frames_done": "Frames finished",
    "frames_failed": "Frames given up",
    "leases_lost": "Leases that ran out because a worker stopped answering",
    "tasks_parked": "Tasks given up after their last attempt",
    "workers_set_aside": "Times that a worker was set aside as its tasks went well elsewhere",
    "samples": "Pixel samples rendered",
}
# What exists before it has happened can be alerted on: a rate needs a first value.
_MEASURED: dict[str, tuple[str, list[str], list[list[str]]]] = {
    "attempts": (
        "Attempts at tasks",
        ["kind", "outcome"],
        [[kind, outcome] for kind in Kind for outcome in ("done", "failed", "given_up")],
    ),
    "phase_seconds": (
        "Seconds of attempts by what they were spent on",
        ["phase"],
        [[phase] for phase in ("load", "plan", "render", "merge", "denoise", "write", "other")],
    ),
    "core_seconds": ("Seconds of attempts times the threads they had", [], [[]]),
    "cpu_seconds": ("Processor seconds that the render processes used", [], [[]]),
    "cache_read_bytes": ("Bytes of caches read", [], [[]]),
}

Family = CounterMetricFamily | GaugeMetricFamily


class _FarmCollector(Collector):
    def __init__(self, queue: Queue, states: Mapping[str, int]) -> None:
        self._queue = queue
        self._states = states

    def collect(self) -> Iterator[Family]:
        stats = self._queue.stats()
        for name, text in _COUNTED.items():
            yield CounterMetricFamily(f"pileus_{name}", text, value=stats.get(name, 0))
        measured = Measures(self._queue.redis).read()
        for name, (text, labels, expected) in _MEASURED.items():
            family = CounterMetricFamily(f"pileus_{name}", text, labels=labels)
            for values in expected:
                family.add_metric(values, measured.get((name, *values), 0.0))
            yield family
        failures = CounterMetricFamily(
            "pileus_attempt_failures", "Attempts that failed, by cause", labels=["cause"]
        )
        for cause in Cause:
            failures.add_metric([cause], measured.get(("failures", cause), 0.0))
        failures.add_metric(["lost"], stats.get("leases_lost", 0))
        yield failures
        yield from self._queued()
        yield from self._workers()

    def _queued(self) -> Iterator[Family]:
        waiting = GaugeMetricFamily("pileus_tasks_waiting", "Tasks queued", labels=["priority"])
        held = GaugeMetricFamily("pileus_tasks_held", "Tasks under lease", labels=["priority"])
        age = GaugeMetricFamily(
            "pileus_queue_age_seconds",
            "How long the task that is next has waited",
            labels=["priority"],
        )
        for priority, line in self._queue.lines().items():
            waiting.add_metric([str(priority)], line.waiting)
            held.add_metric([str(priority)], line.held)
            age.add_metric([str(priority)], line.wait)
        yield from (waiting, held, age)
        jobs = GaugeMetricFamily("pileus_jobs", "Jobs", labels=["state"])
        for state in JobState:
            if state is not JobState.QUEUED:  # not told from those that have begun
                jobs.add_metric([state], self._states.get(state, 0))
        yield jobs

    def _workers(self) -> Iterator[Family]:
        alive = [worker for worker in self._queue.workers() if worker.alive]
        busy = [worker for worker in alive if worker.task]
        # A drained one gets no tasks because somebody wants it so.
        aside = [worker for worker in alive if worker.aside not in (None, DRAINED)]
        for name, text, value in (
            ("workers", "Workers alive", len(alive)),
            ("workers_aside", "Workers alive that are set aside for a fault", len(aside)),
            ("workers_busy", "Workers with a task", len(busy)),
            ("threads", "Threads of the workers alive", sum(each.threads for each in alive)),
            ("threads_busy", "Threads of workers with a task", sum(each.threads for each in busy)),
        ):
            yield GaugeMetricFamily(f"pileus_{name}", text, value=value)


def exposition(queue: Queue, states: Mapping[str, int]) -> bytes:
    """`states` says how many jobs there are in each."""
    registry = CollectorRegistry()
    registry.register(_FarmCollector(queue, states))
    return generate_latest(registry)
