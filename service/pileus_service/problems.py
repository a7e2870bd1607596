"""Every error of the API as an RFC 9457 problem document."""

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from redis.exceptions import RedisError
from starlette.exceptions import HTTPException
from starlette.routing import Match
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pileus_service.errors import ForeignError, InputError, in_plain_words, own_troubles, place_of
from pileus_service.headers import HEADERS
from pileus_service.queue import trouble

MEDIA_TYPE = "application/problem+json"


class FieldError(BaseModel):
    pointer: str
    detail: str


class ProblemDocument(BaseModel):
    """What a client gets in place of an answer."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    errors: list[FieldError] = []


class Problem(HTTPException):
    """Raised by routes; status and the one line that tells the trouble and the mend."""


def _answer(
    status: int, detail: str, errors: list[FieldError], headers: Mapping[str, str] | None = None
) -> JSONResponse:
    document = ProblemDocument(
        title=HTTPStatus(status).phrase, status=status, detail=detail, errors=errors
    )
    # An unforeseen error is answered outside all middleware, hence the security headers here.
    told = {**HEADERS, **(headers or {})}
    return JSONResponse(document.model_dump(), status, headers=told, media_type=MEDIA_TYPE)


def install(app: FastAPI) -> None:
    """Makes every error of the app a problem document, and says so in its OpenAPI page."""
    describe = app.openapi

    def with_problems() -> dict[str, Any]:
        document = describe()
        schemas = document["components"]["schemas"]
        template = "#/components/schemas/{model}"
        problem = ProblemDocument.model_json_schema(ref_template=template)
        schemas |= {**problem.pop("$defs"), "ProblemDocument": problem}
        return document

    setattr(app, "openapi", with_problems)  # noqa: B010, the way FastAPI documents

    @app.exception_handler(HTTPException)
    def http(request: Request, error: HTTPException) -> JSONResponse:
        headers = error.headers
        if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
            # Starlette names the methods of the first route with this path alone.
            found = [
                route for route in app.routes if route.matches(request.scope)[0] is not Match.NONE
            ]
            methods = {method for route in found for method in getattr(route, "methods", ())}
            headers = {"Allow": ", ".join(sorted(methods))}
        return _answer(error.status_code, str(error.detail), [], headers)

    @app.exception_handler(RequestValidationError)
    def invalid(_: Request, error: RequestValidationError) -> JSONResponse:
        troubles = own_troubles(error.errors())[:20]
        errors = [
            FieldError(pointer="/" + "/".join(place_of(each)), detail=in_plain_words(each))
            for each in troubles
        ]
        return _answer(422, f"{'.'.join(place_of(troubles[0]))}: {errors[0].detail}", errors)

    @app.exception_handler(InputError)
    def refused(_: Request, error: InputError) -> JSONResponse:
        return _answer(422, str(error), [])

    @app.exception_handler(ForeignError)
    def foreign(_: Request, error: ForeignError) -> JSONResponse:
        return _answer(503, str(error), [], {"Retry-After": "10"})

    @app.exception_handler(RedisError)
    def no_redis(_: Request, error: RedisError) -> JSONResponse:
        detail = f"Redis does not answer: {trouble(error)}; try again"
        return _answer(503, detail, [], {"Retry-After": "2"})

    @app.exception_handler(OSError)
    def no_disk(_: Request, error: OSError) -> JSONResponse:
        return _answer(503, f"The data folder fails: {error.strerror}", [], {"Retry-After": "10"})

    @app.exception_handler(Exception)
    def unforeseen(_: Request, error: Exception) -> JSONResponse:
        return _answer(500, "An unforeseen error; the service's log has it", [])


class BodyLimit:
    """ASGI middleware that refuses bodies over a size, announced or not."""

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app = app
        self._limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        got = 0

        async def bounded() -> Message:
            nonlocal got
            message = await receive()
            got += len(message.get("body", b""))
            if got > self._limit:
                raise Problem(413, f"The body has over {self._limit} bytes")
            return message

        await self._app(scope, bounded, send)


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """What a route's OpenAPI entry says of the problems that it answers with."""
    schema = {"$ref": "#/components/schemas/ProblemDocument"}
    return {
        status: {
            "description": HTTPStatus(status).phrase,
            "content": {MEDIA_TYPE: {"schema": schema}},
        }
        for status in statuses
    }


GUARDED = responses(401, 403, 429, 503)
RESPONSES = GUARDED | responses(400, 404, 409, 413, 422)
