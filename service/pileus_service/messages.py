"""The bodies of the HTTP API that are no views."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field
from pydantic.config import JsonDict

from pileus_service.jobs import JobView, Priority
from pileus_service.shot import Shot

_EXAMPLE: JsonDict = {
    "priority": 5,
    "shot": {
        "name": "steam",
        "frames": "1-3",
        "image": {"width": 960, "height": 540, "output": "frames/steam.####.exr"},
        "volumes": [{"cache": "caches/cloud.####.vdb", "extinction": 60.0, "anisotropy": 0.85}],
        "camera": {"position": [0.0, 0.1, 2.0], "look_at": [0.0, 0.0, 0.0]},
        "lights": [{"type": "dome", "radiance": [0.2, 0.3, 0.5]}],
        "sampling": {"samples": 128},
    },
}


class Submission(BaseModel):
    """A shot and how urgent it is: 0 to 9, the higher the sooner. The job's end is told to
    `webhook`, if the farm's keeper has allowed its origin. With `wait_for_caches` its caches may
    still be in the making: each frame waits for its own."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [_EXAMPLE]})
    shot: Shot
    priority: Priority = 5
    webhook: Annotated[str, Field(min_length=1, max_length=2000)] | None = None
    wait_for_caches: bool = False


class Accepted(BaseModel):
    """A job and what is odd about its shot."""

    job: JobView
    warnings: list[str]


class Change(BaseModel):
    model_config = ConfigDict(extra="forbid")
    priority: Priority
