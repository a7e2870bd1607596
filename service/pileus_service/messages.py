"""The bodies of the HTTP API that are no views."""

from pydantic import BaseModel, ConfigDict

from pileus_service.jobs import JobView, Priority
from pileus_service.shot import Shot


class Submission(BaseModel):
    """A shot and how urgent it is: 0 to 9, the higher the sooner."""

    model_config = ConfigDict(extra="forbid")
    shot: Shot
    priority: Priority = 5


class Accepted(BaseModel):
    """A job and what is odd about its shot."""

    job: JobView
    warnings: list[str]


class Change(BaseModel):
    model_config = ConfigDict(extra="forbid")
    priority: Priority
