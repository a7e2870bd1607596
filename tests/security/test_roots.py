"""The roots hold: against what a path says, and against what it comes to mean once checked."""

import ctypes
import os
import shutil
import stat
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pileus_core as core
import pytest
from fastapi.testclient import TestClient

from pileus_service.app import create_app
from pileus_service.auth import Guard
from pileus_service.errors import InputError
from pileus_service.farm import Farm
from pileus_service.jobs import Done, Kind
from pileus_service.queue import Queue
from pileus_service.roots import Roots
from pileus_service.shot import Shot
from pileus_service.store import Store
from pileus_worker.caches import Caches
from pileus_worker.paths import NOWHERE_ELSE
from pileus_worker.tasks import Work
from render_fixtures import camera_around, make_scene


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "root" / "inner").mkdir(parents=True)
    (tmp_path / "root" / "inner" / "file").write_text("inside")
    return tmp_path / "root"


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "file").write_text("outside")
    return tmp_path / "outside"


def read(roots: Roots, path: Path) -> str:
    with roots.reading(path) as location:
        return Path(location).read_text()


def names(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir()]


def write(roots: Roots, path: Path, text: str) -> None:
    """As the renderer does: a temporary file beside it, then a rename."""
    with roots.writing(path) as location:
        temporary = Path(location + ".tmp")
        temporary.write_text(text)
        temporary.rename(location)


def test_files_of_a_root_are_read_and_written_links_within_it_followed(root: Path) -> None:
    roots = Roots([root])
    (root / "link").symlink_to("inner")
    (root / "other").symlink_to(root / "link" / "file")
    for name in ("inner/file", "link/file", "other", "inner/../inner/file"):
        assert read(roots, root / name) == "inside"
    write(roots, root / "link" / "new" / "deep" / "a.exr", "written")
    assert (root / "inner" / "new" / "deep" / "a.exr").read_text() == "written"


def test_a_root_may_be_reached_by_a_link(root: Path, tmp_path: Path) -> None:
    (tmp_path / "show").symlink_to(root)
    assert read(Roots([tmp_path / "show"]), tmp_path / "show" / "inner" / "file") == "inside"


@pytest.mark.parametrize(
    "path",
    ["../outside/file", "folder/file", "file", "inner/../../outside/file", "/etc/passwd",
     "/proc/self/root/etc/passwd", "/proc/self/environ", "rooted"],
)  # fmt: skip
def test_what_leads_out_is_neither_read_nor_written(root: Path, outside: Path, path: str) -> None:
    roots = Roots([root])
    (root / "folder").symlink_to(outside)
    (root / "file").symlink_to(outside / "file")
    # A folder whose name begins like the root's is none of it.
    (root.parent / "rooted").mkdir()
    (root / "rooted").symlink_to(root.parent / "rooted")
    with pytest.raises(InputError, match="lies outside the roots"), roots.reading(root / path):
        pass
    before = sorted(outside.parent.rglob("*"))
    if path != "file":
        with pytest.raises(InputError, match="lies outside the roots"), \
             roots.writing(root / path / "a.exr"):  # fmt: skip
            pass
    assert sorted(outside.parent.rglob("*")) == before


def test_a_link_in_the_place_of_an_image_is_replaced(root: Path, outside: Path) -> None:
    (root / "a.exr").symlink_to(outside / "file")
    write(Roots([root]), root / "a.exr", "image")
    assert (outside / "file").read_text() == "outside"
    assert not (root / "a.exr").is_symlink()


def test_what_is_no_file_is_refused_at_once(root: Path) -> None:
    roots = Roots([root])
    os.mkfifo(root / "fifo")
    (root / "loop").symlink_to("loop")
    (root / "gone").symlink_to("nowhere")
    nodes = ["fifo", "inner"]
    if os.geteuid() == 0:
        os.mknod(root / "zero", 0o600 | stat.S_IFCHR, os.makedev(1, 5))
        nodes.append("zero")
    for name in nodes:
        with pytest.raises(InputError, match="is no regular file"), roots.reading(root / name):
            pass
    for name, said in (("loop", "circle of links"), ("gone", "no such file"), ("x" * 300, "name")):
        with pytest.raises(InputError, match=said), roots.reading(root / name):
            pass


def test_the_farms_own_folder_is_no_root(root: Path, shot: dict[str, Any]) -> None:
    (root / "data" / "tokens").mkdir(parents=True)
    (root / "data" / "tokens" / "ops.json").write_text("{}")
    roots = Roots([root], barred=root / "data")
    with pytest.raises(InputError, match="farm's own folder"):
        read(roots, root / "data" / "tokens" / "ops.json")
    with pytest.raises(InputError, match="farm's own folder"):
        write(roots, root / "data" / "tokens" / "evil.exr", "")
    shot["image"]["output"] = str(root / "data" / "a.####.exr")
    shot["volumes"][0]["cache"] = str(root / "a.vdb")
    with pytest.raises(InputError, match=r"image.output: .*farm's own folder"):
        roots.check(Shot.model_validate(shot), [1])


def test_odd_paths_of_a_shot_are_one_line(root: Path, shot: dict[str, Any]) -> None:
    (root / "loop").symlink_to("loop")
    for cache in ("loop/a.vdb", "x" * 300 + "/a.vdb", "inner/file/a.vdb", "%99d/%99d/%99d.vdb"):
        shot["volumes"][0]["cache"] = str(root / cache)
        shot["image"]["output"] = str(root / "a.####.exr")
        try:
            Roots([root]).check(Shot.model_validate(shot), [1])
        except InputError as error:
            assert "\n" not in str(error)
            assert "volumes.0.cache" in str(error)


@pytest.fixture
def swapped(root: Path, outside: Path) -> Iterator[Path]:
    """A folder of the root that changes places with a link outwards, as fast as it can."""
    place, link = root / "inner", root / "away"
    link.symlink_to(outside)
    over = threading.Event()
    libc, here, exchange = ctypes.CDLL(None), -100, 2  # AT_FDCWD, RENAME_EXCHANGE

    def swap() -> None:
        while not over.is_set():
            assert libc.renameat2(here, bytes(place), here, bytes(link), exchange) == 0

    swapper = threading.Thread(target=swap)
    swapper.start()
    yield place
    over.set()
    swapper.join()


def test_a_folder_swapped_for_a_link_after_the_check_leads_nowhere(
    swapped: Path, root: Path, outside: Path
) -> None:
    """A race that is run until both outcomes were seen often: nothing gets past the roots."""
    roots = Roots([root])
    told = {"read": 0, "written": 0, "refused": 0}
    for n in range(20_000):
        try:
            assert read(roots, swapped / "file") == "inside"
            told["read"] += 1
            write(roots, swapped / f"{n}.exr", "image")
            told["written"] += 1
        except InputError:
            told["refused"] += 1
        assert names(outside) == ["file"]
        if n > 1000 and min(told.values()) > 30:
            break
    assert min(told.values()) > 0, told


def test_a_swap_at_each_single_step_is_seen(
    root: Path, outside: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The swap happens right after the links were followed: the worst moment there is."""
    roots = Roots([root])
    resolve = Path.resolve

    def and_then_swap(path: Path, strict: bool = False) -> Path:
        real = resolve(path, strict)
        if (root / "inner").is_dir() and not (root / "inner").is_symlink():
            (root / "inner").rename(root / "was")
            (root / "inner").symlink_to(outside)
        return real

    monkeypatch.setattr(Path, "resolve", and_then_swap)
    with pytest.raises(InputError):
        read(roots, root / "inner" / "file")
    (root / "inner").unlink()
    (root / "was").rename(root / "inner")
    with pytest.raises(InputError):
        write(roots, root / "inner" / "a.exr", "image")
    assert names(outside) == ["file"]


def test_the_renderer_reads_and_writes_at_such_locations(root: Path) -> None:
    """And its errors name the path that a user knows."""
    roots = Roots([root])
    core.make_cloud(str(root / "a.vdb"), frame=1, frames=1, resolution=16)
    with roots.reading(root / "a.vdb") as location:
        assert core.Volume(location).active_voxels > 0
    (root / "b.vdb").write_text("no vdb")
    with pytest.raises(core.InputError) as error, roots.reading(root / "b.vdb") as location:
        core.Volume(location)
    assert str(error.value).startswith(f"{root}/b.vdb: ")
    assert "/proc" not in str(error.value)


def test_the_service_sends_no_image_that_was_swapped_for_a_link(
    farm: Farm, shot: dict[str, Any], tmp_path: Path, outside: Path
) -> None:
    """An image of the farm's, replaced by a link to what its owner may not read."""
    roots = Roots([tmp_path / "out", tmp_path / "caches"])
    farm = Farm(Store(tmp_path / "data"), Queue(farm.queue.redis), roots)
    client = TestClient(create_app(farm, Guard()), base_url="http://127.0.0.1")
    job = client.post("/v1/jobs", json={"shot": shot}).json()["job"]["id"]
    image = tmp_path / "out" / "test.0001.exr"
    image.parent.mkdir(exist_ok=True)
    image.write_bytes(b"an image" * 100_000)
    done = Done(frame=1, file=str(image), seconds=1, samples=1, method="single",
                max_bounces=1, reason="")  # fmt: skip
    farm.store.frame(job, 1).mark_done(done)
    url = f"/v1/jobs/{job}/frames/1/image.exr"
    opened = len(names(Path("/proc/self/fd")))
    for _ in range(3):
        answer = client.get(url)
        assert (answer.status_code, answer.content) == (200, image.read_bytes())
        assert "test.0001.exr" in answer.headers["content-disposition"]
    assert client.get(url, headers={"Range": "bytes=3-7"}).content == b"image"
    assert len(names(Path("/proc/self/fd"))) == opened, "a file was left open"
    image.unlink()
    image.symlink_to(outside / "file")
    answer = client.get(url)
    assert answer.status_code == 404
    assert "outside the roots" in answer.json()["detail"]


@pytest.mark.parametrize("what", ["caches", "sky", "out"])
def test_a_task_whose_files_are_swapped_after_its_check_reads_and_writes_none_outside(
    farm: Farm, shot: dict[str, Any], tmp_path: Path, outside: Path,
    monkeypatch: pytest.MonkeyPatch, what: str
) -> None:  # fmt: skip
    """The whole way of a frame: cache, texture and image, each made to lead outwards in turn."""
    cache = tmp_path / "caches" / "cloud.0001.vdb"
    core.make_cloud(str(cache), frame=1, frames=1, resolution=16)
    (tmp_path / "sky").mkdir()
    texture = tmp_path / "sky" / "sky.ppm"
    texture.write_bytes(b"P6 2 1 255 " + bytes(range(6)))
    for file in (cache, texture):
        shutil.copy2(file, outside)  # the same to the nanosecond: none but its place gives it away
    (tmp_path / "out").mkdir()
    shot["lights"][1]["texture"] = str(texture)
    roots = Roots([tmp_path / name for name in ("caches", "sky", "out")])
    farm = Farm(Store(tmp_path / "data"), Queue(farm.queue.redis), roots)
    view, _ = farm.submit(Shot.model_validate(shot), 5, None)
    job = farm.store.job(view.id)
    assert job is not None

    def run(kind: Kind, part: int = 0) -> Any:
        return Work(farm.store, roots, Caches(1 << 30, reading=roots.reading), 1, 1.0,
                    job, 1, kind, part, NOWHERE_ELSE, lambda: None, False).run()  # fmt: skip

    check = Roots.check

    def check_and_swap(self: Roots, *arguments: Any) -> None:
        check(self, *arguments)
        (tmp_path / what).rename(tmp_path / "was")
        (tmp_path / what).symlink_to(outside)

    planned = run(Kind.PLAN)
    for part in range(planned.tasks if what == "out" else planned.tasks - 1):
        run(Kind.RENDER, part)
    before = sorted(outside.iterdir())
    monkeypatch.setattr(Roots, "check", check_and_swap)
    last = (Kind.MERGE, 0) if what == "out" else (Kind.RENDER, planned.tasks - 1)
    with pytest.raises(InputError, match="outside the roots"):
        run(*last)
    assert sorted(outside.iterdir()) == before
    monkeypatch.undo()
    (tmp_path / what).unlink()
    (tmp_path / "was").rename(tmp_path / what)
    run(Kind.RENDER, planned.tasks - 1)
    run(Kind.MERGE)
    assert (tmp_path / "out" / "test.0001.exr").stat().st_size > 0


def test_a_link_laid_in_the_place_of_a_temporary_file_is_not_followed(
    root: Path, outside: Path
) -> None:
    """Whoever may write in the folder of an image can guess the name that it first has."""
    core.make_cloud(str(root / "a.vdb"), frame=1, frames=1, resolution=16)
    volume = core.Volume(str(root / "a.vdb"))
    dome = core.DomeLight(radiance=(1, 1, 1), texture="")
    scene = make_scene(volume, camera_around(volume), [dome], extinction=1.0, size=4)
    transport = core.Transport(method="single", max_bounces=1, looks=[core.Look(name="a")])
    part = core.render(scene, transport, bucket=(0, 0, 4, 4), samples=(0, 1), seed=1, frame=1)
    trap = root / f"a.exr.{os.getpid()}.tmp"
    trap.symlink_to(outside / "file")
    part.write(str(root / "a.exr"), "identity")
    assert (outside / "file").read_text() == "outside"
    assert core.Partial.read(str(root / "a.exr")).identity == "identity"
    assert not trap.is_symlink()
