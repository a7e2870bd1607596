"""The HTTP API over a real Redis, with the tests as its workers: answers, refusals, trust."""

import json
import re
import threading
import time
from collections.abc import Callable, Container, Iterator
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, cast

import httpx
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from redis import Redis

from pileus_service.app import create_app
from pileus_service.auth import Guard
from pileus_service.client import Client
from pileus_service.errors import FarmError, InputError
from pileus_service.farm import Farm
from pileus_service.jobs import NEW_ID, Job, Merged, Planned, Wish, WorkerInfo
from pileus_service.queue import Queue, connect
from pileus_service.server import make_server
from pileus_service.shot import Shot
from pileus_service.store import Store
from pileus_worker.private_redis import PrivateRedis

LOCAL = "http://127.0.0.1"
WORKER = WorkerInfo(name="W", host="host", pid=1, threads=1, started=0.0)


@pytest.fixture
def client(farm: Farm) -> Iterator[TestClient]:
    with TestClient(create_app(farm, Guard()), base_url=LOCAL) as client:
        yield client


def submit(client: TestClient, shot: dict[str, Any], **more: Any) -> str:
    answer = client.post("/v1/jobs", json={"shot": shot, **more})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["job"]["id"])


def problem(answer: Any, status: int) -> str:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    body = answer.json()
    assert body["status"] == status
    assert body.keys() == {"type", "title", "status", "detail", "errors"}
    return str(body["detail"])


def wait_for(what: Callable[[], bool]) -> None:
    end = time.monotonic() + 10
    while not what():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_job_is_taken_shown_steered_and_removed(client: TestClient, shot: dict[str, Any]) -> None:
    job = submit(client, shot, priority=7)
    seen = client.get(f"/v1/jobs/{job}").json()
    assert (seen["state"], seen["priority"], seen["frames"]) == ("queued", 7, 3)
    frames = client.get(f"/v1/jobs/{job}/frames", params={"offset": 1}).json()
    assert [frame["frame"] for frame in frames] == [2, 3]
    assert client.patch(f"/v1/jobs/{job}", json={"priority": 2}).json()["priority"] == 2
    assert client.post(f"/v1/jobs/{job}/pause").json()["state"] == "paused"
    assert client.post(f"/v1/jobs/{job}/resume").json()["state"] == "queued"
    assert client.post(f"/v1/jobs/{job}/cancel").json()["state"] == "cancelled"
    assert client.post(f"/v1/jobs/{job}/resume").json()["state"] == "cancelled"
    assert [each["id"] for each in client.get("/v1/jobs").json()] == [job]
    assert client.delete(f"/v1/jobs/{job}").status_code == 204
    problem(client.get(f"/v1/jobs/{job}"), 404)


def test_an_idempotency_key_makes_one_job_of_many_submissions(
    client: TestClient, shot: dict[str, Any]
) -> None:
    def post(body: dict[str, Any]) -> Any:
        return client.post("/v1/jobs", json={"shot": body}, headers={"Idempotency-Key": "k1"})

    first, second = post(shot), post(shot)
    assert (first.status_code, second.status_code) == (201, 200)
    assert first.json()["job"]["id"] == second.json()["job"]["id"]
    assert "Idempotency-Key" in problem(post({**shot, "name": "other"}), 409)


def test_a_job_that_is_removed_as_it_comes_is_a_conflict(
    client: TestClient, farm: Farm, shot: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    create = farm.store.create

    def create_and_remove(job: Job, wish: Wish) -> bool:
        new = create(job, wish)
        assert farm.remove(job.id)
        return new

    monkeypatch.setattr(farm.store, "create", create_and_remove)
    assert "submit it anew" in problem(client.post("/v1/jobs", json={"shot": shot}), 409)


def test_what_is_on_disk_is_taken_though_redis_goes(
    farm: Farm, shot: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    create = farm.store.create
    with PrivateRedis(tmp_path / "redis") as own, connect(own.farm_url) as redis:
        farm = Farm(farm.store, Queue(redis), farm.roots)

        def create_and_end(job: Job, wish: Wish) -> bool:
            new = create(job, wish)
            own.end()
            return new

        monkeypatch.setattr(farm.store, "create", create_and_end)
        with TestClient(create_app(farm, Guard()), base_url=LOCAL) as client:
            answer = client.post("/v1/jobs", json={"shot": shot, "priority": 7})
            assert answer.status_code == 201, answer.text
            own.keep_up()
            told = answer.json()["job"]
            wait_for(lambda: bool(redis.ping()) and farm.queue.job_ids(10) == [told["id"]])
            now = client.get(f"/v1/jobs/{told['id']}").json()
    assert {**told, "created": 0, "active": []} == {**now, "created": 0, "active": []}


def test_a_lost_answer_makes_no_second_job(
    farm: Farm, shot: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    answers: list[httpx.Response] = []
    silent = threading.Event()

    class Lossy(BaseHTTPRequestHandler):
        """Gives a submission's first answer to nobody, and to any question none at all."""

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            kept = {name: self.headers[name] for name in ("Content-Type", "Idempotency-Key")}
            answers.append(api.post(self.path, content=body, headers=kept))
            if len(answers) > 1:
                self.send_response(answers[-1].status_code)
                self.end_headers()
                self.wfile.write(answers[-1].content)

        def do_GET(self) -> None:
            silent.wait()

        def log_message(self, *_: object) -> None:
            pass

    monkeypatch.setattr("pileus_service.client.ANSWER", 0.5)
    api = TestClient(create_app(farm, Guard()), base_url=LOCAL)
    with ThreadingHTTPServer(("127.0.0.1", 0), Lossy) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with Client(f"http://127.0.0.1:{server.server_port}") as client:
            job = client.submit(Shot.model_validate(shot)).job.id
            with pytest.raises(FarmError, match=r"did not answer in 0.5 s and may have done"):
                next(client.jobs())
        silent.set()
        server.shutdown()
    assert NEW_ID.fullmatch(job), "ids sort by time"
    assert [answer.status_code for answer in answers] == [201, 200]
    assert farm.queue.job_ids(10) == [job]


def test_wrong_input_is_a_problem_that_points_at_the_field(
    client: TestClient, shot: dict[str, Any], tmp_path: Path
) -> None:
    wrong = {**shot, "sampling": {"samples": 0}}
    assert "samples" in problem(client.post("/v1/jobs", json={"shot": wrong}), 422)
    wrong = {**shot, "volumes": [{**shot["volumes"][0], "extinction": -1}]}
    [error] = client.post("/v1/jobs", json={"shot": wrong}).json()["errors"]
    assert error["pointer"] == "/body/shot/volumes/0/extinction"
    sun = {"type": "distant", "direction": [0, -1, 0], "irradiance": [-1, 1, 1]}
    answer = client.post("/v1/jobs", json={"shot": {**shot, "lights": [sun]}}).json()
    [error] = answer["errors"]
    assert error["pointer"] == "/body/shot/lights/0/irradiance/0"
    assert answer["detail"].startswith("body.shot.lights.0.irradiance.0: ")
    wrong = {**shot, "image": 3}
    assert "must be a table" in problem(client.post("/v1/jobs", json={"shot": wrong}), 422)
    problem(
        client.post("/v1/jobs", content=b"{", headers={"content-type": "application/json"}), 422
    )
    problem(client.post("/v1/jobs", content=b" " * (2 << 20)), 413)
    problem(client.get("/v1/jobs/UPPER"), 422)
    problem(client.get("/v1/jobs/nobody"), 404)
    problem(client.get("/v1/jobs", params={"limit": 100_000}), 422)
    problem(client.get("/nowhere"), 404)
    problem(client.put("/v1/jobs"), 405)
    keys = [{"frame": frame, "value": [0.0, 0.0, frame - 2.0]} for frame in (1, 3)]
    wrong = {**shot, "camera": {"position": keys, "look_at": [0.0, 0.0, 0.0]}}
    detail = problem(client.post("/v1/jobs", json={"shot": wrong}), 422)
    assert "no view at frame 2" in detail
    (tmp_path / "caches" / "cloud.0002.vdb").unlink()
    assert "gap" in problem(client.post("/v1/jobs", json={"shot": shot}), 422)


def test_paths_outside_the_roots_are_refused_links_followed(
    client: TestClient,
    shot: dict[str, Any],
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    outside = tmp_path_factory.mktemp("outside")
    (outside / "a.vdb").touch()
    (tmp_path / "link").symlink_to(outside)
    (tmp_path / "file.vdb").symlink_to(outside / "a.vdb")
    for cache in ("/etc/passwd", "link/a.vdb", "file.vdb", "../../a.vdb", f"{outside}/a.vdb"):
        bad = {**shot, "volumes": [{"cache": cache, "extinction": 1.0}]}
        assert "outside the roots" in problem(client.post("/v1/jobs", json={"shot": bad}), 422)
    output = {**shot["image"], "output": "link/a.####.exr"}
    bad = {**shot, "image": output}
    assert "image.output" in problem(client.post("/v1/jobs", json={"shot": bad}), 422)


def test_health_metrics_and_the_api_page(client: TestClient, shot: dict[str, Any]) -> None:
    submit(client, shot, priority=3)
    assert client.get("/healthz").json()["status"] == "ok"
    assert client.get("/readyz").is_success
    assert 'pileus_tasks_waiting{priority="3"} 2.0' in client.get("/metrics").text
    wait_for(lambda: 'pileus_jobs{state="running"} 1.0' in client.get("/metrics").text)
    assert client.get("/docs").is_success
    document = client.get("/openapi.json")
    assert "/v1/jobs/{job_id}/frames/{frame}/preview.png" in document.json()["paths"]
    named = set(re.findall(r'"#/components/schemas/([^"]+)"', document.text))
    assert "ProblemDocument" in named
    assert named <= document.json()["components"]["schemas"].keys()


def test_events_tell_each_change_until_the_end(
    client: TestClient, farm: Farm, shot: dict[str, Any]
) -> None:
    job = submit(client, {**shot, "frames": "1"})
    states = []
    with client.stream("GET", f"/v1/jobs/{job}/events") as answer:
        for line in answer.iter_lines():
            if line.startswith("data:"):
                states.append(json.loads(line[5:])["state"])
                if len(states) == 1:
                    work(farm)
    assert states[0] == "queued"
    assert states[-1] == "done"


def work(farm: Farm) -> None:
    """Does all tasks there are as a worker would, without rendering."""
    while task := farm.queue.claim(WORKER, farm.store.farm()):
        planned = Planned(tasks=0, finished=[], total=0, samples=0)
        farm.queue.complete(task, "W", planned if task.kind == "plan" else Merged())


def test_a_redis_that_was_emptied_is_filled_again_from_disk(
    client: TestClient, farm: Farm, shot: dict[str, Any], redis: Redis
) -> None:
    done = submit(client, {**shot, "frames": "1"})
    work(farm)
    paused = submit(client, shot, priority=8)
    cancelled = submit(client, shot)
    client.post(f"/v1/jobs/{paused}/pause")
    client.post(f"/v1/jobs/{cancelled}/cancel")
    wait_for(lambda: farm.store.wished(done).state == "done")
    redis.flushall()
    wait_for(lambda: len(farm.queue.job_ids(10)) == 3)
    states = {each["id"]: each["state"] for each in client.get("/v1/jobs").json()}
    assert states == {done: "done", paused: "paused", cancelled: "cancelled"}
    assert client.get(f"/v1/jobs/{paused}").json()["priority"] == 8


def test_a_change_that_redis_forgot_is_made_again(
    client: TestClient, farm: Farm, shot: dict[str, Any]
) -> None:
    job = submit(client, shot)
    client.post(f"/v1/jobs/{job}/pause")
    farm.queue.control(job, "resume")  # as after a restart that lost the last second
    wait_for(lambda: farm.queue.state(job) == "paused")


def test_a_redis_that_knows_another_job_of_the_same_key_is_put_right(
    client: TestClient, farm: Farm, shot: dict[str, Any], redis: Redis
) -> None:
    """Its frames are those of the shot that was removed: a worker would look for one in vain."""

    def post(frames: str) -> str:
        body = {"shot": {**shot, "frames": frames}}
        answer = client.post("/v1/jobs", json=body, headers={"Idempotency-Key": "k1"})
        return str(answer.json()["job"]["id"])

    job = post("1-3")
    dump = cast(Callable[..., bytes], redis.execute_command)
    earlier = [(key, dump("DUMP", key, NEVER_DECODE=True)) for key in redis.scan_iter()]
    client.delete(f"/v1/jobs/{job}")
    assert post("1-2") == job
    wait_for(lambda: farm.agreement.states() == {"running": 1})
    redis.flushall()
    for key, value in earlier:
        redis.restore(key, 0, value)
    wait_for(lambda: client.get(f"/v1/jobs/{job}").json()["frames"] == 2)


def test_garbage_in_redis_keeps_the_service_from_nothing(
    client: TestClient, farm: Farm, shot: dict[str, Any], redis: Redis
) -> None:
    time.sleep(1.5)  # the service has looked, and there was nothing
    job = submit(client, shot)
    redis.hset("pileus:standing", "NO JOB", "what")
    redis.zadd("pileus:changed", {"NO JOB": redis.incr("pileus:changes")})
    time.sleep(1.5)
    redis.delete("pileus:standing")
    redis.flushall()
    wait_for(lambda: farm.queue.job_ids(10) == [job])


def test_of_many_listeners_each_hears_the_end_once(
    client: TestClient, farm: Farm, shot: dict[str, Any]
) -> None:
    job = submit(client, {**shot, "frames": "1"})

    def listen() -> list[str]:
        with client.stream("GET", f"/v1/jobs/{job}/events") as answer:
            lines = [line[5:] for line in answer.iter_lines() if line.startswith("data:")]
        return [json.loads(line)["state"] for line in lines]

    with ThreadPoolExecutor(24) as crowd:
        heard = [crowd.submit(listen) for _ in range(20)]
        client.post(f"/v1/jobs/{job}/pause")
        heard += [crowd.submit(listen) for _ in range(4)]  # late, and told by the same look
        time.sleep(1.5)
        client.post(f"/v1/jobs/{job}/resume")
        work(farm)
        told = [each.result(30) for each in heard]
    assert all(states[-1] == "done" and states.count("done") == 1 for states in told), told
    assert all("paused" in states for states in told), told


def test_a_data_folder_that_fails_is_a_problem_and_not_for_ever(
    client: TestClient, farm: Farm, shot: dict[str, Any]
) -> None:
    away = farm.store.root / "away"
    farm.store.jobs_folder.rename(away)
    farm.store.jobs_folder.touch()  # as where the disk that is mounted there has gone
    answer = client.post("/v1/jobs", json={"shot": shot})
    assert "data folder" in problem(answer, 503)
    assert answer.headers["Retry-After"]
    farm.store.jobs_folder.unlink()
    away.rename(farm.store.jobs_folder)
    job = submit(client, shot)
    assert client.post(f"/v1/jobs/{job}/cancel").json()["state"] == "cancelled"


def test_a_data_folder_that_is_not_mounted_any_more_costs_no_job(
    client: TestClient, farm: Farm, shot: dict[str, Any]
) -> None:
    job = submit(client, shot)
    root, away = farm.store.root, farm.store.root.with_name("away")
    root.rename(away)
    farm.store.jobs_folder.mkdir(parents=True)  # a worker's doing, say
    assert "mount" in problem(client.post("/v1/jobs", json={"shot": shot}), 503)
    assert "mount" in problem(client.get("/readyz"), 503)
    time.sleep(1.5)
    assert farm.queue.job_ids(10) == [job]
    assert not list(farm.store.jobs_folder.iterdir())
    farm.store.jobs_folder.rmdir()
    root.rmdir()
    away.rename(root)
    submit(client, shot)
    wait_for(lambda: farm.agreement.states() == {"running": 2})


def test_a_data_folder_that_goes_amid_a_look_costs_no_job(
    farm: Farm, shot: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    view, _ = farm.submit(Shot.model_validate(shot), 5, None)
    root, list_jobs = farm.store.root, farm.store.job_ids

    def unmounted(known: Container[str]) -> Iterator[str]:
        root.rename(root.with_name("away"))
        farm.store.jobs_folder.mkdir(parents=True)
        return list_jobs(known)

    monkeypatch.setattr(farm.store, "job_ids", unmounted)
    with pytest.raises(InputError, match="mount"):
        farm.agreement.reconcile()
    assert farm.queue.job_ids(10) == [view.id]


def test_two_farms_on_one_redis_leave_each_others_jobs(
    client: TestClient, farm: Farm, shot: dict[str, Any], redis_url: str
) -> None:
    job = submit(client, shot)
    other = farm.store.root.with_name("other")
    with pytest.raises(InputError, match="another data folder"):
        make_server(other, redis_url, farm.roots.folders, "127.0.0.1:0")
    second = TestClient(create_app(Farm(Store(other), farm.queue, farm.roots), Guard()), LOCAL)
    assert "another data folder" in problem(second.post("/v1/jobs", json={"shot": shot}), 503)
    assert farm.queue.job_ids(10) == [job]
    farm.queue.redis.flushall()
    assert second.post("/v1/jobs", json={"shot": shot}).is_success, "Redis was emptied for it"


def test_no_redis_is_a_problem_not_a_stack_trace(farm: Farm, shot: dict[str, Any]) -> None:
    dead = Redis.from_url("unix:///nowhere/redis", decode_responses=True)
    app: FastAPI = create_app(Farm(farm.store, Queue(dead), farm.roots), Guard())
    client = TestClient(app, base_url=LOCAL)
    assert "nothing listens" in problem(client.get("/v1/jobs"), 503)
    problem(client.get("/readyz"), 503)
    assert client.get("/healthz").is_success
