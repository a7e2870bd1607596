"""Mutated caches, images and shots: each ends in an image or in one line, within the limits, and
costs no worker. A few hundred here, 10,000 in the slow tier."""

import random
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pileus_core as core
import pytest

import hostile
from hostile import Reader, hostile_files, mutated, seeds
from pileus_service.client import Client
from pileus_service.shot import Shot
from pileus_worker.embedded import embedded_farm


@pytest.fixture
def reader() -> Iterator[Reader]:
    reader = Reader()
    yield reader
    reader.close()


@pytest.fixture(scope="session")
def odd_caches(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """A cache of each kind of grid, and of what a grid may hold."""
    folder = tmp_path_factory.mktemp("odd")
    script = Path(hostile.__file__).with_name("odd_caches.py")
    told = subprocess.run(["/usr/bin/python3", script, folder], capture_output=True, text=True)
    if "No module named 'pyopenvdb'" in told.stderr:
        pytest.skip("needs Debian's python3-openvdb (`make test-slow` installs it)")
    assert told.returncode == 0, told.stderr
    return [path.read_bytes() for path in sorted(folder.iterdir())]


def look_through(
    reader: Reader, folder: Path, suffix: str, count: int, seed: int, more: Sequence[bytes] = ()
) -> None:
    """Reads mutants; what is said of each must be one line, and nothing may end the process."""
    told: Counter[str] = Counter()
    for number, path, _ in hostile_files(folder, suffix, count, seed, more):
        outcome = reader.read(path)
        told[outcome.how] += 1
        assert outcome.how in ("ok", "refused", "memory"), f"mutant {number} of {seed}: {outcome}"
        if outcome.how == "refused":
            assert outcome.line.isprintable(), outcome.line
            assert len(outcome.line) < 2000
    # Mutants that all fail in the first bytes would test little.
    assert told["refused"] > count // 20
    assert told["ok"] > 0, told


@pytest.mark.parametrize(("suffix", "count"), [(".vdb", 100), (".exr", 150), (".toml", 150)])
def test_a_mutant_is_read_or_refused_in_one_line(
    reader: Reader, tmp_path: Path, suffix: str, count: int
) -> None:
    look_through(reader, tmp_path, suffix, count, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10, 20))
@pytest.mark.parametrize(("suffix", "count"), [(".vdb", 400), (".exr", 400), (".toml", 200)])
def test_ten_thousand_mutants(
    reader: Reader,
    tmp_path: Path,
    request: pytest.FixtureRequest,
    suffix: str,
    count: int,
    seed: int,
) -> None:
    # Where these cannot be made, the other kinds of file are still read.
    more = request.getfixturevalue("odd_caches") if suffix == ".vdb" else []
    look_through(reader, tmp_path, suffix, count, seed, more)


@pytest.mark.slow
def test_mutants_of_images_that_coverage_guides(tmp_path: Path) -> None:
    """libFuzzer keeps the mutants that reach code which none before has, and mutates those."""
    if shutil.which("clang++") is None:
        pytest.skip("needs clang (`make test-slow` installs it)")
    core_folder = Path(hostile.__file__).parents[1] / "core"
    build, corpus = tmp_path / "build", tmp_path / "corpus"
    configure: list[str | Path] = ["cmake", "-S", core_folder, "-B", build, "-G", "Ninja"]
    compiled: list[str | Path] = ["cmake", "--build", build, "--target", "fuzz_read_images"]
    for command in ([*configure, "-DCMAKE_CXX_COMPILER=clang++"], compiled):
        subprocess.run(command, check=True, capture_output=True)
    corpus.mkdir()
    for number, image in enumerate(seeds(tmp_path)[".exr"]):
        (corpus / str(number)).write_bytes(image)
    told = subprocess.run(
        # A mutant that takes long is not wrong: OpenEXR's own searches of a spoiled file are.
        [
            *(build / "fuzz_read_images", corpus, "-runs=50000", "-seed=5", "-max_len=8192"),
            *("-use_value_profile=1", "-timeout=120", "-rss_limit_mb=0", "-malloc_limit_mb=0"),
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=1800,
    )
    assert told.returncode == 0, told.stderr[-3000:]
    assert "Done 50000 runs" in told.stderr
    # It was guided: the corpus has grown.
    assert len(list(corpus.iterdir())) > 100


def test_what_python_would_not_print_is_shown_escaped_in_an_error(tmp_path: Path) -> None:
    """A mark that turns the line around, an end of the line."""
    file = tmp_path / "a\u202eb\nd\u00e9j\u00e0.vdb"
    file.write_bytes(b"no vdb")
    with pytest.raises(core.InputError) as refused:
        core.Volume(str(file))
    assert str(refused.value).startswith(
        f"{tmp_path}/a\\u202eb\\nd\u00e9j\u00e0.vdb: cannot be read"
    )


def test_a_texture_with_a_channel_of_no_known_kind_is_refused(
    reader: Reader, tmp_path: Path
) -> None:
    """OpenEXR looks at the channels of those types of part that it knows; OpenImageIO ends the
    process at such a channel."""
    right = seeds(tmp_path)[".exr"][0]
    kind = b"variance.G\0" + (2).to_bytes(4, "little")
    spoiled = right.replace(kind, kind[:-4] + (3).to_bytes(4, "little"))
    file = tmp_path / "sky.exr"
    file.write_bytes(spoiled.replace(b"scanlineimage", b"scanlineimago"))
    outcome = reader.read(file)
    assert outcome.how == "refused", outcome
    assert "of no known kind" in outcome.line


@pytest.mark.parametrize("frames", [8, pytest.param(60, marks=pytest.mark.slow)])
def test_a_farm_on_hostile_caches_loses_no_worker(
    tmp_path: Path, shot: dict[str, Any], frames: int
) -> None:
    """A sequence of mutants: each frame is done or says why not, by the workers of the start."""

    (tmp_path / "caches").mkdir()
    right = seeds(tmp_path)[".vdb"]
    for number in range(1, frames + 1):
        dice = random.Random(f"farm.{number}")
        data = right[0] if number == 1 else mutated(right[0], right, dice)
        (tmp_path / "caches" / f"cloud.{number:04d}.vdb").write_bytes(data)
    shot |= {"frames": f"1-{frames}", "sampling": {"samples": 1}}
    shot["image"] |= {"width": 8, "height": 8}
    with (
        embedded_farm(tmp_path / "farm", [tmp_path], 2, "127.0.0.1:0") as farm,
        Client(farm.url) as client,
    ):
        while len(workers := {each.name for each in client.workers() if each.alive}) < 2:
            pass
        job = client.submit(Shot.model_validate(shot)).job.id
        *_, view = client.watch(job)
        assert view.frames_done + view.frames_failed == frames
        for frame in client.frames(job):
            assert frame.state in ("done", "failed")
            assert frame.state == "done" or (frame.reason and frame.reason.isprintable())
            assert frame.frame != 1 or frame.state == "done"
        assert {each.name for each in client.workers() if each.alive} == workers
