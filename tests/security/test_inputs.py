"""Properties of what a user writes: frame ranges, path patterns, shot files. Each is taken with the
meaning that an independent reading gives it, or refused in one line."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from pileus_service.app import MAX_BODY, create_app
from pileus_service.auth import Guard
from pileus_service.errors import InputError
from pileus_service.farm import Farm
from pileus_service.frames import MAX_FRAMES, expand, has_pattern, parse_frames
from pileus_service.shot import Shot
from pileus_service.shotfile import MAX_BYTES, load_shot, parse_shot

# The same examples on each machine, however slow it is.
settings.register_profile(
    "steady",
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
settings.load_profile("steady")

SHOT: dict[str, Any] = {
    "name": "test",
    "frames": "1-3",
    "image": {"width": 48, "height": 32, "output": "out/test.####.exr"},
    "volumes": [{"cache": "caches/cloud.####.vdb", "extinction": 20.0}],
    "camera": {"position": [0.15, 0.12, 1.9], "look_at": [0.0, 0.02, 0.0], "fov": 35.0},
    "lights": [{"type": "dome", "radiance": [0.3, 0.35, 0.4], "texture": "sky.exr"}],
    "transport": {"method": "multiple", "looks": [{"name": "hero", "a": 0.65}]},
    "sampling": {"samples": 4, "seed": 7},
}

ranges = st.lists(
    st.tuples(st.integers(0, 300), st.integers(0, 300), st.integers(1, 50)), min_size=1, max_size=6
)


@given(ranges, st.sampled_from(["", " ", "  "]))
def test_frame_ranges_are_the_union_of_their_parts(
    parts: list[tuple[int, int, int]], space: str
) -> None:
    texts, expected = [], set()
    for first, length, step in parts:
        last = first + length
        texts.append(f"{first}-{last}x{step}" if length or step > 1 else str(first))
        expected |= {frame for frame in range(1000) if first <= frame <= last
                     and (frame - first) % step == 0}  # fmt: skip
    assert parse_frames(f",{space}".join(texts)) == tuple(sorted(expected))


@given(st.text(alphabet="0123456789-x, ٣²", max_size=30) | st.text(max_size=30))
@example(f"1-{MAX_FRAMES + 1}")
@example(",".join(f"{i}-{i + 90_000}" for i in (0, 100_000)))
@example("9" * 5000)
def test_a_frame_range_is_taken_or_refused_and_never_long(text: str) -> None:
    try:
        frames = parse_frames(text)
    except ValueError as error:
        assert "\n" not in str(error) or "\n" in text
    else:
        assert 0 < len(frames) <= MAX_FRAMES
        assert list(frames) == sorted(set(frames))


name = st.text(alphabet="abc._-", max_size=8)
literal = st.text(alphabet="abc./_-", max_size=8)


@given(literal, name, st.integers(0, 10**9), st.integers(1, 12))
def test_the_three_kinds_of_pattern_put_the_number_alike(
    head: str, tail: str, frame: int, width: int
) -> None:
    number = str(frame).zfill(width)
    for pattern in ("#" * width, f"%0{width}d", f"$F{width}"):
        assert expand(head + pattern + tail, frame) == head + number + tail
        assert has_pattern(head + pattern + tail)
        assert expand(f"{head}{pattern}/{tail}", frame) == f"{head}{pattern}/{tail}"
        assert not has_pattern(f"{head}{pattern}/{tail}")
    for pattern in ("%d", "$F"):
        assert expand(head + pattern + tail, frame) == f"{head}{frame}{tail}"
    assert expand(head + tail, frame) == head + tail
    assert not has_pattern(head + tail)


@given(st.text(max_size=40), st.integers(0, 10**9), st.integers(0, 10**9))
def test_no_pattern_puts_anything_but_digits_into_a_path(text: str, one: int, two: int) -> None:
    name = expand(text, one)
    assert name.count("/") == text.count("/")
    assert name.count("..") == text.count("..")
    assert (expand(text, two) == name) or has_pattern(text)


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner),
    max_leaves=8,
)
edges = st.sampled_from(
    [0, -1, 1, 2**31, 2**63, 2**64, 10**400, 1e308, -0.0, 5e-324, float("nan"), float("inf"),
     "", "\n", "\x00", "a\nb", "\ud800", "../a.exr", "/" * 1100, "####.exr", [], {}, [[[]]], True]
)  # fmt: skip


def places(thing: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The way to each value of a shot."""
    items = thing.items() if isinstance(thing, dict) else enumerate(thing)
    found = []
    for key, value in items:
        found.append((*path, key))
        if isinstance(value, dict | list):
            found += places(value, (*path, key))
    return found


@st.composite
def spoiled(draw: st.DrawFn) -> dict[str, Any]:
    """A right shot in which some values were put in the place of others, or taken out."""
    shot = json.loads(json.dumps(SHOT))
    for _ in range(draw(st.integers(1, 3))):
        *way, last = draw(st.sampled_from(places(shot)))
        here = shot
        for step in way:
            here = here[step]
        if draw(st.booleans()):
            here[last] = draw(values | edges)
        else:
            del here[last]
    return dict(shot)


def one_line(error: InputError) -> bool:
    return str(error).isprintable() and len(str(error)) < 1500


@settings(max_examples=300)
@given(spoiled())
def test_a_spoiled_shot_is_a_shot_or_one_line(data: dict[str, Any]) -> None:
    try:
        shot = parse_shot(data, "shot.toml")
    except InputError as error:
        assert one_line(error), repr(str(error))
        return
    # What was taken means the same after its way through HTTP and the disk.
    assert Shot.model_validate_json(shot.model_dump_json()) == shot
    assert Shot.model_validate(json.loads(json.dumps(shot.model_dump(mode="json")))) == shot
    assert 0 < len(shot.frame_numbers) <= MAX_FRAMES
    shot.camera.at(shot.frame_numbers[0])
    for frame in shot.frame_numbers[:2]:
        assert all(path for _, path in shot.inputs(frame))


@settings(max_examples=200)
@given(
    st.binary(max_size=60) | st.text(max_size=60).map(str.encode), st.sampled_from(["toml", "json"])
)
@example(b"[" * 100_000, "json")
@example(b"a=" + b"[" * 100_000, "toml")
@example(b"a=" + b"{b=" * 50_000, "toml")
@example(b'{"frames": ' + b"9" * 5000 + b"}", "json")
@example(b"frames = " + b"9" * 5000, "toml")
@example(b" " * (2 << 20), "toml")
def test_any_file_is_a_shot_or_one_line(tmp_path: Path, data: bytes, kind: str) -> None:
    file = tmp_path / f"shot.{kind}"
    file.write_bytes(data)
    with pytest.raises(InputError) as refused:
        load_shot(file)
    assert one_line(refused.value), repr(str(refused.value))
    assert ("is this a shot?" in str(refused.value)) == (len(data) > MAX_BYTES)


@settings(max_examples=200)
@given(st.text(max_size=30), st.text(max_size=30))
@example("sampling.samples", "9" * 5000)
@example("a", "[" * 100_000)
@example("lights.9999999999999999999999", "1")
@example("lights.²", "1")
def test_any_setting_is_taken_or_one_line(tmp_path: Path, key: str, value: str) -> None:
    file = tmp_path / "shot.json"
    file.write_text(json.dumps(SHOT))
    try:
        load_shot(file, [f"{key}={value}"])
    except InputError as error:
        assert "Traceback" not in str(error)
        assert "\n" not in str(error) or "\n" in key + value


def toml(value: Any) -> str:
    """An independent writer, for what a shot holds."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value)


@settings(max_examples=50)
@given(st.integers(1, 1 << 20), st.floats(1e-3, 1e6), st.text("abc é", min_size=1, max_size=9))
def test_toml_and_json_say_the_same(
    tmp_path: Path, samples: int, extinction: float, name: str
) -> None:
    data = json.loads(json.dumps(SHOT)) | {"name": name, "sampling": {"samples": samples}}
    data["volumes"][0]["extinction"] = extinction
    (tmp_path / "a.json").write_text(json.dumps(data))
    text = "\n".join(f"{key} = {toml(value)}" for key, value in data.items())
    assert tomllib.loads(text) == data
    (tmp_path / "a.toml").write_text(text, encoding="utf-8")
    assert load_shot(tmp_path / "a.toml") == load_shot(tmp_path / "a.json")
    # As an editor of another system may write them.
    (tmp_path / "b.toml").write_text(text, encoding="utf-8-sig")
    (tmp_path / "b.JSON").write_text(json.dumps(data), encoding="utf-8-sig")
    assert load_shot(tmp_path / "b.toml") == load_shot(tmp_path / "b.JSON")


def without(path: str, value: Any) -> dict[str, Any]:
    """The shot with one value changed."""
    shot: dict[str, Any] = json.loads(json.dumps(SHOT))
    *way, last = path.split(".")
    here: Any = shot
    for step in way:
        here = here[int(step) if step.isdecimal() else step]
    here[last] = value
    return shot


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("frames", f"1-{MAX_FRAMES + 1}"),
        ("frames", ",".join(map(str, range(3000)))),
        ("image.width", 65537),
        ("image.height", 0),
        ("sampling.samples", (1 << 20) + 1),
        ("transport.max_bounces", 65537),
        ("transport.looks", [{"name": f"look{i}"} for i in range(17)]),
        ("lights", [{"type": "dome", "radiance": [1.0, 1.0, 1.0]}] * 65),
        ("camera.fov", [{"frame": i, "value": 30.0} for i in range(10_001)]),
        ("image", {"width": 65536, "height": 65536, "output": "a.####.exr"}),
        ("name", "n" * 201),
        ("volumes.0.cache", "c" * 1025),
    ],
)
def test_each_count_is_bounded_with_the_field_that_is_over(
    farm: Farm, field: str, value: Any
) -> None:
    client = TestClient(create_app(farm, Guard()), base_url="http://127.0.0.1")
    answer = client.post("/v1/jobs", json={"shot": without(field, value)})
    assert answer.status_code == 422
    assert f"body.shot.{field.split('.')[0]}" in answer.json()["detail"]
    assert not client.get("/v1/jobs").json()


def test_an_image_that_no_machine_could_hold_is_refused(farm: Farm) -> None:
    client = TestClient(create_app(farm, Guard()), base_url="http://127.0.0.1")
    shot = without("transport.looks", [{"name": f"look{i}"} for i in range(16)])
    shot["image"] |= {"width": 8192, "height": 8192, "orders": True}
    answer = client.post("/v1/jobs", json={"shot": shot})
    assert answer.status_code == 422
    assert "take fewer pixels, looks or orders" in answer.json()["detail"]


@pytest.mark.parametrize("announced", [True, False])
def test_a_body_over_its_bound_is_413_announced_or_not(farm: Farm, announced: bool) -> None:
    client = TestClient(create_app(farm, Guard()), base_url="http://127.0.0.1")
    told = 0

    def parts() -> Any:
        nonlocal told
        for _ in range(1000):
            told += 1
            yield b" " * (MAX_BODY // 8)

    content = b" " * (MAX_BODY + 1) if announced else parts()
    answer = client.post("/v1/jobs", content=content)
    assert answer.status_code == 413
    assert str(MAX_BODY) in answer.json()["detail"]


def test_a_body_that_nests_without_end_is_a_problem_document(farm: Farm) -> None:
    client = TestClient(create_app(farm, Guard()), base_url="http://127.0.0.1")
    for body in (b"[" * 500_000, b'{"shot":' * 100_000, b"9" * 10_000, b'{"shot":"\\ud800"}'):
        answer = client.post("/v1/jobs", content=body, headers={"Content-Type": "application/json"})
        assert answer.status_code in (400, 422)
        assert answer.headers["content-type"] == "application/problem+json"
