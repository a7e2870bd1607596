"""The dashboard and the alerts ask for what the farm exports, and Prometheus understands them."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families
from redis import Redis

from pileus_service import metrics
from pileus_service.jobs import Wish
from pileus_service.queue import Queue
from queueing import A, B

FOLDER = Path(__file__).parent.parent / "deploy" / "monitoring"


@pytest.fixture
def exposition(redis: Redis) -> str:
    queue = Queue(redis)
    queue.submit("job", "job", 0.0, 1, Wish())
    return metrics.exposition(queue, {"running": 1}).decode()


def expressions() -> dict[str, str]:
    """Every expression that is asked, by the panel or alert that asks it."""
    asked = {}
    for panel in json.loads((FOLDER / "dashboard.json").read_text())["panels"]:
        for target in panel["targets"]:
            asked[f"{panel['title']} {target['refId']}"] = target["expr"]
    for group in yaml.safe_load((FOLDER / "alerts.yml").read_text())["groups"]:
        for rule in group["rules"]:
            asked[rule["alert"]] = rule["expr"]
    return asked


def test_every_metric_and_label_that_is_asked_for_is_exported(exposition: str) -> None:
    exported: dict[str, dict[str, set[str]]] = {}
    for family in text_string_to_metric_families(exposition):
        for sample in family.samples:
            for label, value in sample.labels.items():
                exported.setdefault(sample.name, {}).setdefault(label, set()).add(value)
            exported.setdefault(sample.name, {})
    asked = expressions()
    assert len(asked) > 20
    for where, expression in asked.items():
        names = re.findall(r"\b(pileus_\w+)(?:\{(\w+)=(~?)\"([^\"]+)\"\})?", expression)
        assert names or "up{" in expression, where
        for name, label, matching, value in names:
            assert name in exported, f"{where}: {name}"
            if label:
                values = exported[name][label]
                assert matching or value in values, f"{where}: {label}={value}, not {values}"
        for label in re.findall(r"by \((\w+)\)", expression):
            assert all(label in exported[name] for name, *_ in names), f"{where}: by {label}"


def test_every_metric_and_phase_that_the_page_tells_of_is_exported(exposition: str) -> None:
    page = (FOLDER.parents[1] / "docs" / "watching.md").read_text()
    told = set(re.findall(r"`(pileus_\w+)`", page))
    assert len(told) > 10
    assert all(f"\n{name} " in exposition or f"\n{name}{{" in exposition for name in told), told
    [phases] = re.findall(r"by `phase`: ([\w, ]+)", page)
    exported = re.findall(r'phase_seconds_total\{phase="(\w+)"', exposition)
    assert exported == phases.strip().split(", ")


def test_a_worker_counts_as_set_aside_for_a_fault_and_not_for_being_drained(redis: Redis) -> None:
    queue = Queue(redis)
    queue.claim(A, able=False, trouble="no memory")
    queue.claim(B)
    queue.drain("B")
    exposition = metrics.exposition(queue, {}).decode()
    assert "\npileus_workers 2.0" in exposition
    assert "\npileus_workers_aside 1.0" in exposition


@pytest.mark.slow
def test_prometheus_understands_the_rules_and_the_metrics(exposition: str) -> None:
    """What the rules do on made-up series is in alerts_test.yml."""
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not here: apt-get install prometheus")
    for command in (
        ("check", "config", "prometheus.yml"),
        ("check", "rules", "alerts.yml"),
        ("test", "rules", "alerts_test.yml"),
    ):
        subprocess.run([promtool, *command], cwd=FOLDER, check=True)
    subprocess.run([promtool, "check", "metrics"], input=exposition, text=True, check=True)
