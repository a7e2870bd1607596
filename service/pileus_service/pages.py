"""The pages: at `/` the farm's, which asks the JSON API for all that it shows, and at `/docs` the
API's own description. Both are static and load no file of another site."""

from importlib.resources import files

from fastapi import FastAPI
from fastapi.responses import HTMLResponse
from fastapi.staticfiles import StaticFiles

# They load their own files and show pictures that they fetched themselves; they can be fed no
# script. Swagger UI has pictures in its style sheet.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
PAGES = {"/": "index.html", "/docs": "api.html"}


def install(app: FastAPI) -> None:
    """Puts the pages and their files into the app; they hold nothing secret and need no token."""
    app.mount("/web/swagger", StaticFiles(packages=[("fastapi_offline", "static")]))
    app.mount("/web", StaticFiles(packages=[("pileus_service", "web")]))
    for address, name in PAGES.items():
        _serve(app, address, (files("pileus_service") / "web" / name).read_text())


def _serve(app: FastAPI, address: str, page: str) -> None:
    @app.get(address, include_in_schema=False)
    def show() -> HTMLResponse:
        return HTMLResponse(page, headers={"Content-Security-Policy": POLICY})
