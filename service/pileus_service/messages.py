"""The bodies of the HTTP API that are no views."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from pileus_service.jobs import JobView, Priority
from pileus_service.shot import Shot


class Submission(BaseModel):
    """A shot and how urgent it is: 0 to 9, the higher the sooner. The job's end is told to
    `webhook`, if the farm's keeper has allowed its origin."""

    model_config = ConfigDict(extra="forbid")
    shot: Shot
    priority: Priority = 5
    webhook: Annotated[str, Field(min_length=1, max_length=2000)] | None = None


class Accepted(BaseModel):
    """A job and what is odd about its shot."""

    job: JobView
    warnings: list[str]


class Change(BaseModel):
    model_config = ConfigDict(extra="forbid")
    priority: Priority
