"""The page at `/`: a static one, which asks the JSON API for all that it shows."""

from importlib.resources import files

from fastapi import FastAPI
from fastapi.responses import HTMLResponse
from fastapi.staticfiles import StaticFiles

# It loads its own files and shows pictures that it fetched itself; it can be fed no script.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def install(app: FastAPI) -> None:
    """Puts the page and its files into the app; they hold nothing secret and need no token."""
    page = (files("pileus_service") / "web" / "index.html").read_text()
    app.mount("/web", StaticFiles(packages=[("pileus_service", "web")]))

    @app.get("/", include_in_schema=False)
    def index() -> HTMLResponse:
        return HTMLResponse(page, headers={"Content-Security-Policy": POLICY})
