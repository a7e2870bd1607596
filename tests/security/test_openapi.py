"""Schemathesis over the whole OpenAPI document: no server error, no answer that it does not tell.

Its requests are right, wrong and odd; where a job is asked for it is mostly one that is there.
"""

from pathlib import Path
from typing import Any
from zlib import crc32

import pytest
import schemathesis
from schemathesis import engine
from schemathesis.config import SchemathesisConfig
from schemathesis.engine import events

from pileus_service import auth
from pileus_service.app import create_app
from pileus_service.auth import Guard, Role, Tokens
from pileus_service.farm import Farm
from pileus_service.jobs import Done
from pileus_service.shot import Shot

CONFIG: dict[str, Any] = {
    "generation": {"max-examples": 10, "deterministic": True, "no-shrink": True},
    # What one request made, or took away, others ask for.
    "phases": {"stateful": {"max-steps": 6, "generation": {"max-examples": 20}}},
    # A shot can be right for the document and yet be refused: its caches are not there, two of its
    # values contradict each other.
    "checks": {"positive_data_acceptance": {"expected-statuses": ["2xx", "404", "409", "422"]}},
}


@pytest.fixture
def api(
    farm: Farm, shot: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> schemathesis.BaseSchema:
    """The API as an administrator beyond the loopback meets it, with jobs that have ended."""
    # Some checks come with wrong tokens; here it is not their number that is in question.
    monkeypatch.setattr(auth, "FAILURES_A_MINUTE", 1_000_000)
    ended = []
    for _ in range(3):
        job, _ = farm.submit(Shot.model_validate(shot), 5, None)
        farm.control(job.id, "cancel")
        files = farm.store.frame(job.id, 1)
        image = Path(shot["image"]["output"].replace("####", "0001"))
        for file in (files.preview, image):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(b"an image")
        done = Done(frame=1, file=str(image), seconds=1, samples=1, method="single",
                    max_bounces=1, reason="")  # fmt: skip
        files.mark_done(done)
        ended.append(job.id)
    tokens = Tokens(tmp_path / "data")
    token = tokens.create("schemathesis", Role.ADMIN)
    config = SchemathesisConfig.from_dict(
        CONFIG | {"headers": {"Authorization": f"Bearer {token}"}}
    )
    schema = schemathesis.openapi.from_asgi(
        "/openapi.json", create_app(farm, Guard(tokens)), config=config
    )

    @schema.hook
    def map_path_parameters(_: Any, given: dict[str, Any] | None) -> dict[str, Any] | None:
        if given and "job_id" in given and (chance := crc32(repr(given).encode())) % 3:
            given["job_id"] = ended[chance % len(ended)]
            given |= {"frame": 1} if "frame" in given and chance % 2 else {}
        return given

    return schema


def troubles(schema: schemathesis.BaseSchema) -> tuple[int, list[str]]:
    """How many requests were made, and each check that failed, with the request that failed it."""
    requests, found = 0, []
    for event in engine.from_schema(schema).execute():
        if isinstance(event, events.ScenarioFinished):
            recorder = event.recorder
            requests += len(recorder.interactions)
            for checks in recorder.checks.values():
                for check in checks:
                    if check.failure_info is not None:
                        sample = check.failure_info.code_sample
                        failure = check.failure_info.failure
                        found.append(
                            f"{recorder.label}: {failure.title}: {failure.message}\n{sample}"
                        )
        elif isinstance(event, events.NonFatalError):
            found.append(f"{event.label}: {event.value!r}")
        elif isinstance(event, events.FatalError):
            raise event.exception
    return requests, found


def test_no_request_meets_an_answer_that_is_not_described(api: schemathesis.BaseSchema) -> None:
    requests, found = troubles(api)
    assert not found, "\n\n".join(found)
    assert requests > 500
