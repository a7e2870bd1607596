"""deploy/containers and deploy/systemd, really run: images built upon a bare Debian 12, a farm of
their containers, by hand and by a compose file, and the same files under a systemd of their own, in
its sandbox.
"""

import contextlib
import hashlib
import json
import os
import re
import shutil
import socket
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pileus_core as core
import pytest
import yaml

from hosts import free_port, process, same_images, until
from pileus_service.client import Client
from pileus_service.shot import Shot
from pileus_worker.paths import PathMap
from pileus_worker.private_redis import NO_PASSWORD_FITS

ROOT = Path(__file__).parent.parent
DEPLOY = ROOT / "deploy"
TOOLS = ("buildah", "debootstrap", "podman-compose", "systemd-nspawn", "systemd-analyze")
USER = 970
PASSWORD = "a secret"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        os.geteuid() != 0 or not all(map(shutil.which, TOOLS)),
        reason="needs root, buildah, podman and systemd (`make test-slow` installs them)",
    ),
    pytest.mark.xdist_group("deployed"),
]


def run(*words: str | Path) -> str:
    ended = subprocess.run(words, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    assert ended.returncode == 0, ended.stdout[-2000:] + ended.stderr[-2000:]
    return ended.stdout.strip()


class Buildah:
    """Its commands over a store of our own, without a container runtime."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._store = ["--root", str(folder / "store"), "--runroot", str(folder / "run")]
        self._options: list[str] = []
        self._trust_what_this_host_trusts(folder)

    def __call__(self, *words: str | Path) -> str:
        return run("buildah", *self._store, *words)

    def build(self, name: str) -> None:
        """Builds deploy/containers/NAME.Containerfile as pileus-NAME."""
        file = DEPLOY / "containers" / f"{name}.Containerfile"
        options = ["--isolation", "chroot", "--format", "docker", "--build-arg", "BASE=bare"]
        self("build", *options, *self._options, "-f", file, "-t", f"pileus-{name}", ROOT)

    def container(self, image: str) -> "Container":
        return Container(self, image, self("from", f"localhost/{image}"))

    def command(self, *words: str | Path) -> list[str | Path]:
        return ["buildah", *self._store, *words]

    def _trust_what_this_host_trusts(self, folder: Path) -> None:
        """Behind a proxy that signs with an authority of its own, pip needs that authority."""
        pip = [sys.executable, "-m", "pip", "config", "get", "global.cert"]
        asked = subprocess.run(pip, capture_output=True, text=True)
        authority = os.environ.get("PIP_CERT") or asked.stdout.strip()
        if authority:
            shutil.copy(authority, folder / "authority.pem")
            (folder / "pip.conf").write_text("[global]\ncert = /opt/authority.pem\n")
            self._options += ["--volume", f"{folder}/authority.pem:/opt/authority.pem:ro"]
            self._options += ["--volume", f"{folder}/pip.conf:/etc/pip.conf:ro"]


class Container:
    """A container of an image, run as an engine would: its entry point, user and health check."""

    def __init__(self, buildah: Buildah, image: str, name: str) -> None:
        self._buildah = buildah
        self.name = name
        told = json.loads(buildah("inspect", "--type", "image", f"localhost/{image}"))
        self.config: dict[str, Any] = told["Docker"]["config"]
        self.options: list[str] = []

    def run(self, *words: str | Path, user: str = "") -> str:
        options = [*self.options, *(["--user", user] if user else [])]
        return self._buildah("run", "--isolation", "chroot", *options, self.name, "--", *words)

    def start(self, log: Path, *words: str) -> contextlib.AbstractContextManager[object]:
        command = [*self.config["Entrypoint"], *words]
        options = ["run", "--isolation", "chroot", *self.options, self.name, "--", *command]
        return process(log, *self._buildah.command(*options))

    def healthy(self, port: int = 8765) -> bool:
        _, *check = self.config["Healthcheck"]["Test"]
        try:
            self.run(*(word.replace("8765", str(port)) for word in check))
        except AssertionError:
            return False
        return True


@pytest.fixture(scope="module")
def buildah(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Buildah]:
    """With the two images in its store."""
    folder = tmp_path_factory.mktemp("buildah")
    buildah = Buildah(folder)
    run("debootstrap", "--variant=minbase", "bookworm", folder / "bare")
    bare = buildah("from", "scratch")
    buildah("add", "--quiet", bare, folder / "bare", "/")
    buildah("commit", "--quiet", "--format", "docker", bare, "bare")
    shutil.rmtree(folder / "bare")
    try:
        buildah.build("service")
        buildah.build("worker")
        yield buildah
    finally:
        buildah("rm", "--all")
        buildah("rmi", "--all", "--force")


@pytest.fixture
def shows(tmp_path: Path) -> Path:
    """A folder of caches that the farm's user may write in."""
    shows = tmp_path / "shows"
    shows.mkdir()
    core.make_cloud(str(shows / "cloud.vdb"), frame=1, frames=1, resolution=32)
    os.chown(shows, USER, USER)
    return shows


@pytest.fixture
def asked(shot: dict[str, Any]) -> Shot:
    """A shot as the farm's hosts see it."""
    shot["frames"] = "1-2"
    shot["image"]["output"] = "/shows/out/test.####.exr"
    shot["volumes"][0]["cache"] = "/shows/cloud.vdb"
    return Shot.model_validate(shot)


def finish(client: Client, shot: Shot) -> None:
    job = client.submit(shot).job.id
    until(lambda: client.job(job).state in ("done", "failed"), 300)
    assert client.job(job).state == "done", client.job(job).reason


def connects(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
        return True
    return False


def test_images_hold_no_more_than_they_need_and_run_unprivileged(buildah: Buildah) -> None:
    for name in ("service", "worker"):
        container = buildah.container(f"pileus-{name}")
        assert container.run("id", "-u") == str(USER)
        assert container.run("sh", "-c", "command -v gcc cc c++ cmake pip || echo none") == "none"
    service = buildah.container("pileus-service")
    absent = "import importlib.util as u; print(u.find_spec('pileus_core'), u.find_spec('numpy'))"
    assert service.run("/opt/pileus/bin/python", "-c", absent) == "None None"
    libraries = service.run("sh", "-c", "ls /usr/lib/*/ | grep -E 'openvdb|OpenEXR' || echo none")
    assert libraries == "none"


def test_a_farm_of_containers_renders_a_shot(
    buildah: Buildah, tmp_path: Path, shows: Path, asked: Shot
) -> None:
    compose = yaml.safe_load((DEPLOY / "containers" / "compose.yaml").read_text())["services"]
    farm = tmp_path / "farm"
    farm.mkdir()
    os.chown(farm, USER, USER)
    redis_port, port = free_port(), free_port()
    # Redis's image is another's; its command is ours, and is run here, in a folder of its own.
    script = compose["redis"]["command"][2].replace("$$", "$")
    script = script.replace("/tmp", str(tmp_path)).replace("/etc/pileus", str(DEPLOY))
    script = script.replace("--dir /data", f"--dir {tmp_path} --port {redis_port}")
    environment = dict.fromkeys(compose["redis"]["environment"], PASSWORD)
    url = compose["service"]["environment"]["PILEUS_REDIS"]
    url = url.replace("redis:6379", f"localhost:{redis_port}")
    url = url.replace("${PILEUS_PASSWORD:?choose one}", PASSWORD.replace(" ", "%20"))
    service, worker = buildah.container("pileus-service"), buildah.container("pileus-worker")
    for container in (service, worker):
        container.options = ["--env", f"PILEUS_REDIS={url}"]
        container.options += ["--volume", f"{farm}:/farm", "--volume", f"{shows}:/shows"]
    with process(tmp_path / "redis.log", "sh", "-c", script, env=environment):
        until(lambda: connects(redis_port), 20)
        listen = f"127.0.0.1:{port}"
        with (
            service.start(tmp_path / "service.log", "--listen", listen, "--root", "/shows"),
            Client(f"http://{listen}") as client,
        ):
            until(lambda: connects(port), 180)
            assert service.healthy(port)
            assert not worker.healthy()
            with worker.start(tmp_path / "worker.log", *worker.config["Cmd"], "--threads", "1"):
                until(client.workers, 180)
                assert worker.healthy()
                finish(client, asked)
    assert (shows / "out" / "test.0001.exr").stat().st_uid == USER
    same_images(PathMap.parse([f"/shows={shows}"]).shot(asked), tmp_path)


@pytest.fixture
def compose(
    buildah: Buildah, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., str]]:
    """Commands for an engine over the same store, with settings and networks of its own."""
    redis = buildah("from", "bare")
    install = "apt-get update -qq && apt-get install -qq -y --no-install-recommends redis-server"
    install += " && mkdir /data && chown redis: /data"
    buildah("run", "--isolation", "chroot", redis, "--", "sh", "-c", install)
    # Under the name of the image that the file asks for, and without an entry point of its own.
    buildah("commit", "--quiet", "--format", "docker", redis, "docker.io/library/redis:7-bookworm")
    (tmp_path / "containers.conf").write_text(
        f'''[containers]
        default_ulimits = ["nofile=1024:1024", "nproc=4096:4096"]
        [engine]
        cgroup_manager = "cgroupfs"
        tmp_dir = "{tmp_path}/libpod"
        [network]
        network_config_dir = "{tmp_path}/networks"
        '''
    )
    (tmp_path / "storage.conf").write_text(
        f'''[storage]
        driver = "{buildah("info", "--format", "{{.store.GraphDriverName}}")}"
        graphroot = "{buildah.folder}/store"
        runroot = "{buildah.folder}/run"
        '''
    )
    monkeypatch.setenv("CONTAINERS_CONF", str(tmp_path / "containers.conf"))
    monkeypatch.setenv("CONTAINERS_STORAGE_CONF", str(tmp_path / "storage.conf"))
    monkeypatch.setenv("PILEUS_PASSWORD", PASSWORD)
    # crun refuses a host that has the second cgroups beside the first: the engine sees the first.
    hide = "umount /sys/fs/cgroup/unified; exec sleep infinity"
    with process(tmp_path / "engine.log", "unshare", "--mount", "sh", "-c", hide) as space:
        inside = ["nsenter", "-t", str(space.pid), "--mount"]
        farm = ["podman-compose", "-p", "pileus", "-f", str(DEPLOY / "containers/compose.yaml")]

        def told(*words: str) -> str:
            return run(*inside, *([] if words[0] == "podman" else farm), *words)

        try:
            yield told
        finally:
            told("down")
            told("podman", "volume", "rm", "--all", "--force")


def test_the_compose_file_brings_up_a_farm(
    compose: Callable[..., str],
    tmp_path: Path,
    shows: Path,
    asked: Shot,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    port = free_port()
    farm = tmp_path / "farm"
    farm.mkdir()
    os.chown(farm, USER, USER)
    for name, value in {"FARM": farm, "SHOWS": shows, "PORT": port}.items():
        monkeypatch.setenv(name, str(value))
    create = "token create ops --role admin"
    told = compose("run", "--rm", "-T", "--entrypoint", "pileus", "service", *create.split())
    [token] = re.findall(r"ops\.\S+", told)
    compose("up", "-d", "--no-build")
    with Client(f"http://127.0.0.1:{port}", token) as client:
        until(lambda: connects(port), 180)
        until(client.workers, 180)
        for name in ("service", "worker"):
            compose("podman", "healthcheck", "run", f"pileus_{name}_1")
        finish(client, asked)
    assert (shows / "out" / "test.0001.exr").stat().st_uid == USER
    same_images(PathMap.parse([f"/shows={shows}"]).shot(asked), tmp_path)


def units() -> list[Path]:
    return sorted((DEPLOY / "systemd").glob("*.service"))


def test_units_are_right_and_hardly_exposed(tmp_path: Path) -> None:
    for unit in units():
        there = unit.read_text().replace("/opt/pileus/bin/pileus", "/bin/true")
        (tmp_path / unit.name).write_text(there)
    assert len(units()) == 3
    run("systemd-analyze", "verify", *sorted(tmp_path.glob("*.service")))
    for unit in units():
        # Of 100, 0 being the least exposed; a unit that says nothing has 96.
        run("systemd-analyze", "security", "--offline=yes", "--threshold=20", unit)


@pytest.fixture
def machine(buildah: Buildah, tmp_path: Path) -> Iterator[tuple[Path, int]]:
    """A Debian with systemd and all three units, booted; its root and the service's port."""
    container = buildah.container("pileus-worker")
    packages = "systemd systemd-sysv redis-server openssl"
    container.run("apt-get", "update", "-qq", user="0")
    container.run("apt-get", "install", "-qq", "-y", *packages.split(), user="0")
    root = Path(buildah("mount", container.name))
    redis_port, port = free_port(), free_port()
    for unit in units():
        shutil.copy(unit, root / "etc/systemd/system")
    shutil.copy(DEPLOY / "systemd/pileus.sysusers", root / "usr/lib/sysusers.d/pileus.conf")
    tls = root / "etc/pileus/tls"
    tls.mkdir(parents=True)
    digest = hashlib.sha256(PASSWORD.encode()).hexdigest()
    settings = (DEPLOY / "redis.conf").read_text().replace(NO_PASSWORD_FITS, f"#{digest}")
    (tls.parent / "redis.conf").write_text(settings)
    network = (DEPLOY / "redis-network.conf").read_text().replace("6379", str(redis_port))
    (tls.parent / "redis-network.conf").write_text(network)
    certify = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2"
    certify += " -subj /CN=localhost -addext subjectAltName=DNS:localhost"
    certify += " -keyout /etc/pileus/tls/redis.key -out /etc/pileus/tls/redis.crt"
    run("chroot", root, *certify.split())
    shutil.copy(tls / "redis.crt", tls / "ca.crt")
    example = (DEPLOY / "systemd/farm.env").read_text()
    address = f"{PASSWORD.replace(' ', '%20')}@localhost:{redis_port}"
    (tls.parent / "farm.env").write_text(example.replace("PASSWORD@redis.example:6379", address))
    override = root / "etc/systemd/system/pileus-service.service.d/here.conf"
    override.parent.mkdir()
    [start] = [line for line in units()[1].read_text().splitlines() if line.startswith("ExecStart")]
    here = start.replace("0.0.0.0:8765", f"127.0.0.1:{port}")
    override.write_text(f"[Service]\nExecStart=\n{here}\n")
    (root / "etc/hosts").write_text("127.0.0.1 localhost\n")  # an image has none of its own
    run("chroot", root, "systemd-sysusers")
    (root / "srv/pileus/shows").mkdir(parents=True)
    (root / "srv/pileus/farm").mkdir()
    run("chroot", root, "chown", "-R", "pileus:", "/srv/pileus", "/etc/pileus/tls/redis.key")
    run("chroot", root, "systemctl", "disable", "-q", "redis-server")
    run("chroot", root, "systemctl", "enable", "-q", *(unit.name for unit in units()))
    boot = ["systemd-nspawn", "-q", "--register=no", "--keep-unit", "--boot", "-D", str(root)]
    with process(tmp_path / "boot.log", *boot):
        yield root, port


def test_a_farm_of_units_renders_a_shot_in_its_sandbox(
    machine: tuple[Path, int], tmp_path: Path, shows: Path, asked: Shot
) -> None:
    root, port = machine
    place = root / "srv/pileus/shows"
    shutil.copy(shows / "cloud.vdb", place)
    with Client(f"http://127.0.0.1:{port}") as client:
        until(lambda: connects(port), 300)
        until(client.workers, 180)
        worker = client.workers()[0]
        finish(client, PathMap.parse(["/shows=/srv/pileus/shows"]).shot(asked))
        for pid in of_user(USER):
            words = Path(f"/proc/{pid}/status").read_text().splitlines()
            held = dict(word.split(":\t", 1) for word in words if ":\t" in word)
            assert int(held["CapEff"], 16) == 0
            assert (held["NoNewPrivs"], held["Seccomp"]) == ("1", "2")
        inside = ["nsenter", "-t", str(init_of(root)), "-m", "-p", "-u"]
        run(*inside, "systemctl", "kill", "--signal=KILL", "pileus-worker")
        until(lambda: {each.name for each in client.workers() if each.alive} - {worker.name}, 180)
    same_images(PathMap.parse([f"/shows={place}"]).shot(asked), tmp_path)
    for made in (place / "out", place / "out" / "test.0001.exr"):
        assert made.stat().st_mode & stat.S_IROTH, "artists are of no group of the farm's"


def of_user(user: int) -> list[int]:
    """The farm's processes; the user has no others."""
    ended = subprocess.run(["pgrep", "-u", str(user)], capture_output=True, text=True, check=True)
    return [int(word) for word in ended.stdout.split()]


def init_of(root: Path) -> int:
    """The systemd whose root this is."""
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            named = (path / "comm").read_text().strip() == "systemd"
            if named and (path / "root").samefile(root):
                return int(path.name)
    raise AssertionError(f"no systemd runs in {root}")
