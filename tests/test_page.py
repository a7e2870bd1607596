"""The page at `/`: it is whole by itself, asks only what the API answers, works in a browser."""

import re
import shutil
import subprocess
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pileus_core as core
import pytest
from fastapi.testclient import TestClient
from redis import Redis

from pileus_service.app import create_app
from pileus_service.auth import Guard
from pileus_service.client import Client
from pileus_service.farm import Farm
from pileus_service.pages import PAGES
from pileus_service.queue import Queue
from pileus_service.roots import Roots
from pileus_service.shot import Shot
from pileus_service.store import Store
from pileus_worker.embedded import embedded_farm

WEB = Path(__file__).parent.parent / "service" / "pileus_service" / "web"


@pytest.fixture
def client(redis: Redis, tmp_path: Path) -> TestClient:
    farm = Farm(Store(tmp_path / "data"), Queue(redis), Roots([tmp_path]))
    return TestClient(create_app(farm, Guard(None)), base_url="http://127.0.0.1")


@pytest.mark.parametrize("page", PAGES)
def test_a_page_is_whole_by_itself_and_can_be_fed_no_script(client: TestClient, page: str) -> None:
    answer = client.get(page)
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert not re.search(r"<script(?![^>]*src=)|\son\w+=|\sstyle=|<style", answer.text)
    linked = set(re.findall(r'(?:src|href)="([^"#]+)"', answer.text))
    for file in WEB.iterdir():
        text = file.read_text().replace("http://www.w3.org/2000/svg", "")
        assert not re.search(r"https?://", text), file
        assert "innerHTML" not in text, file  # names of jobs are a user's, and no markup
        linked |= set(re.findall(r'from "([^"]+)"', text))
    assert len(linked) >= 6
    for address in linked:
        assert client.get(address).is_success, address


def test_the_page_asks_only_what_the_api_answers(client: TestClient) -> None:
    paths = client.get("/openapi.json").json()["paths"]
    answered = [re.sub(r"\{\w+\}", "[^/]+", path) + r"(\?.*)?" for path in paths]
    script = "".join(file.read_text() for file in WEB.glob("*.js"))
    asked = {
        re.sub(r"\$\{(?:[^{}]|\{[^{}]*\})*\}", "pause", address)
        for address in re.findall(r"[`\"](/v1/[^`\"]*)[`\"]", script)
    }
    assert len(asked) >= 8
    for address in asked:
        assert any(re.fullmatch(path, address) for path in answered), address


def dom(page: str, folder: Path, expected: str = "") -> str:
    """What a browser makes of a page, which must have nothing else to complain of."""
    browser = shutil.which("chromium")
    if browser is None:
        pytest.skip("no browser is here: apt-get install chromium")
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    command += ["--disable-background-networking", "--enable-logging=stderr"]
    command += [f"--user-data-dir={folder / 'profile'}", "--virtual-time-budget=5000", page]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    complaints = [line for line in ended.stderr.splitlines() if "CONSOLE" in line]
    assert all(expected and expected in line for line in complaints), complaints
    return ended.stdout


@pytest.mark.slow
def test_the_api_is_described_in_a_browser(tmp_path: Path) -> None:
    with embedded_farm(tmp_path / "farm", [tmp_path], 1, "127.0.0.1:0") as farm:
        page = dom(f"{farm.url}/docs", tmp_path)
    assert "/v1/jobs/{job_id}" in page.replace("\u200b", "").replace("<wbr>", "")


@pytest.mark.slow
def test_the_page_shows_a_job_in_a_browser(tmp_path: Path, shot: dict[str, Any]) -> None:
    (tmp_path / "caches").mkdir()
    for frame in (1, 3):
        path = tmp_path / "caches" / f"cloud.{frame:04d}.vdb"
        core.make_cloud(str(path), frame=frame, frames=3, resolution=32)
    (tmp_path / "caches" / "cloud.0002.vdb").write_bytes(b"no vdb")
    named = Shot.model_validate(shot | {"name": "<b>cirrus</b>"})
    with (
        embedded_farm(tmp_path / "farm", [tmp_path], 1, "127.0.0.1:0") as farm,
        Client(farm.url) as client,
    ):
        *_, job = client.watch(client.submit(named).job.id)
        page = dom(f"{farm.url}/#{job.id}", tmp_path)
    assert "<h1>&lt;b&gt;cirrus&lt;/b&gt;</h1>" in page
    grid = page[page.index('id="frames"') : page.index('class="key"')]
    assert re.findall(r'<button[^>]*class="(\w+)"', grid) == ["done", "failed", "done"]
    assert 'src="blob:' in page
    assert "cloud.0002.vdb" in page
    assert page.count("threads") + page.count("1 thread") >= 1


class Breaking(BaseHTTPRequestHandler):
    """Passes what is asked on to a farm, and breaks its first stream of events off."""

    protocol_version = "HTTP/1.1"
    farm = ""
    broken = False

    def do_GET(self) -> None:
        answer = httpx.get(self.farm + self.path)
        self.send_response(answer.status_code)
        self.send_header("Content-Type", answer.headers["content-type"])
        self.send_header("Content-Length", str(len(answer.content)))
        self.end_headers()
        if self.path.endswith("/events") and not type(self).broken:
            type(self).broken = self.close_connection = True
        else:
            self.wfile.write(answer.content)


@pytest.mark.slow
def test_the_page_follows_a_job_on_after_its_stream_has_broken(
    tmp_path: Path, shot: dict[str, Any]
) -> None:
    with (
        embedded_farm(tmp_path / "farm", [tmp_path], 1, "127.0.0.1:0") as farm,
        Client(farm.url) as client,
        ThreadingHTTPServer(("127.0.0.1", 0), Breaking) as between,
    ):
        job = client.submit(Shot.model_validate(shot), wait_for_caches=True).job.id
        client.control(job, "cancel")
        Breaking.farm = farm.url
        threading.Thread(target=between.serve_forever).start()
        try:
            address = f"http://127.0.0.1:{between.server_port}/#{job}"
            page = dom(address, tmp_path, expected="net::ERR_CONTENT_LENGTH_MISMATCH")
        finally:
            between.shutdown()
    assert Breaking.broken
    assert '<span class="state cancelled">cancelled</span>' in page
