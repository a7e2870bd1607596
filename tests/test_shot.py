"""Shots: what they mean, and one clear line for each thing that can be wrong with one."""

import json
from pathlib import Path
from typing import Any

import pytest

from pileus_service.errors import InputError
from pileus_service.frames import expand, parse_frames
from pileus_service.shot import Shot
from pileus_service.shotfile import check_camera, check_files, load_shot


@pytest.fixture
def shot_file(tmp_path: Path, shot: dict[str, Any]) -> Path:
    path = tmp_path / "shot.json"
    path.write_text(json.dumps(shot))
    return path


def refusal(shot_file: Path, *settings: str) -> str:
    """The line that a user sees; it names the file and is one line."""
    with pytest.raises(InputError) as caught:
        load_shot(shot_file, settings)
    line = str(caught.value)
    assert "\n" not in line
    return line


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("7", [7]),
        ("1-4", [1, 2, 3, 4]),
        ("1-8x3", [1, 4, 7]),
        ("1-3,2-4,20", [1, 2, 3, 4, 20]),
    ],
)
def test_frame_ranges(text: str, frames: list[int]) -> None:
    assert list(parse_frames(text)) == frames


@pytest.mark.parametrize(
    ("pattern", "name"),
    [
        ("a.####.vdb", "a.0007.vdb"),
        ("a.##.vdb", "a.07.vdb"),
        ("a.%04d.vdb", "a.0007.vdb"),
        ("a.$F4.vdb", "a.0007.vdb"),
        ("a.$F.vdb", "a.7.vdb"),
        ("still.vdb", "still.vdb"),
        ("/take #3/100%d/$F4/a.####.vdb", "/take #3/100%d/$F4/a.0007.vdb"),
    ],
)
def test_frame_patterns(pattern: str, name: str) -> None:
    assert expand(pattern, 7) == name


def test_a_shot_survives_its_json_and_reads_alike_from_toml(shot_file: Path) -> None:
    shot = load_shot(shot_file)
    assert Shot.model_validate_json(shot.model_dump_json()) == shot


def test_paths_are_relative_to_the_file(tmp_path: Path, shot: dict[str, Any]) -> None:
    shot["volumes"][0]["cache"] = "caches/a.####.vdb"
    file = tmp_path / "shot.json"
    file.write_text(json.dumps(shot))
    assert load_shot(file).volumes[0].cache == str(tmp_path / "caches" / "a.####.vdb")


def test_settings_override_lists_by_index_words_and_values(shot_file: Path) -> None:
    settings = ["volumes.0.extinction=7.5", "transport.method=single", "frames=4-5",
                "transport.max_bounces=1", "camera.position=[1.0, 2.0, 3.0]"]  # fmt: skip
    shot = load_shot(shot_file, settings)
    assert shot.volumes[0].extinction == 7.5
    assert (shot.transport.method, shot.frame_numbers) == ("single", (4, 5))
    assert shot.camera.at(1).position == (1.0, 2.0, 3.0)


def test_camera_keys_are_linear_and_hold_at_the_ends(shot_file: Path) -> None:
    shot = load_shot(
        shot_file, ["camera.fov=[{frame = 10, value = 30.0}, {frame = 20, value = 50.0}]"]
    )
    assert [shot.camera.at(frame).fov for frame in (1, 10, 15, 20, 99)] == [30, 30, 40, 50, 50]


def test_a_camera_that_goes_blind_between_its_keys_is_refused_with_the_frame(
    shot_file: Path,
) -> None:
    keys = "[{frame = 1, value = [0, 0, 2]}, {frame = 9, value = [0, 0, -2]}]"
    shot = load_shot(
        shot_file, [f"camera.position={keys}", "camera.look_at=[0, 0, 0]", "frames=1-9"]
    )
    check_camera(shot, "shot.json", [1, 4, 6, 9])
    with pytest.raises(InputError, match=r"^shot\.json: camera: .* no view at frame 5; part"):
        check_camera(shot, "shot.json", shot.frame_numbers)


@pytest.mark.parametrize(
    ("setting", "field", "said"),
    [
        ("sampling.sample=4", "sampling", "did you mean 'samples'?"),
        ("colour=1", "", "unknown key 'colour'"),
        ("sampling.tolerance=0", "sampling.tolerance = 0", "greater than or equal to 0.0001"),
        ("transport.method=auto", "", "give sampling.tolerance"),
        ("transport.reduce_from=0", "transport.reduce_from = 0", "greater than or equal to 1"),
        ("sampling.samples=0", "sampling.samples = 0", "greater than or equal to 1"),
        ("sampling.seed=-1", "sampling.seed", "greater than or equal to 0"),
        ("image.width=1000000000", "image.width = 1000000000", "less than or equal to 65536"),
        ("image={width=65536, height=65536, output='a.####.exr'}", "image", "pixels; make it"),
        ("image.output=a.####.png", "image.output", "must end in .exr"),
        ("image.output=a.exr", "image.output", "every frame would write this one file"),
        ("image.pixel_type=int", "image.pixel_type", "'float' or 'half'"),
        ("frames=9-1", "frames", "runs backwards"),
        ("frames=one", "frames", "is no frame range"),
        ("frames=1-999999999", "frames", "split the shot"),
        ("fps=0", "fps", "greater than 0"),
        ("volumes=[]", "volumes", "has 0 items; give at least 1"),
        ("transport.looks=[]", "transport.looks", "has 0 items; give at least 1"),
        ("volumes.0.albedo=0.5", "volumes.0.albedo = 0.5", "must be a list; put"),
        ("volumes.0.albedo=[1, 1, 1, 1]", "volumes.0.albedo", "more than 3 items; take"),
        ("camera.fov={frame=1, value=9}", "camera.fov", "must be a list; put"),
        ("image=3", "image = 3", "must be a table; give"),
        ("lights=[3]", "lights.0 = 3", "must be a table; give"),
        ("volumes.0.extinction=-1", "volumes.0.extinction", "greater than or equal to 0"),
        ("volumes.0.extinction=nan", "volumes.0.extinction", "finite"),
        ("volumes.0.albedo=[1.0, 1.0, 1.5]", "volumes.0.albedo.2", "less than or equal to 1"),
        ("volumes.0.anisotropy=1", "volumes.0.anisotropy", "less than 1"),
        ("volumes.3.extinction=1", "--set volumes.3", "no index below 1"),
        ("transport.looks.0.a=0.5", "--set transport.looks.0.a", "it, transport.looks=[...]"),
        ("camera.fov=180", "camera.fov", "between 0 and 180"),
        ("camera.look_at=[0.15, 0.12, 1.9]", "camera", "span no view; part"),
        ("lights.0.direction=[0.0, 0.0, 0.0]", "lights.0.direction", "must not be zero"),
        ("lights.0.type=spot", "lights.0", "'type' is 'spot'; give one of 'distant', 'dome'"),
        ("lights.0={angle=1}", "lights.0", "has no 'type'; give one, as 'distant' or 'dome'"),
        ("lights.1.radiance=[-1.0, 0.0, 0.0]", "lights.1.radiance.0", "greater than or equal"),
        ("transport.method=magic", "transport.method", "'reference'"),
        ("transport.max_bounces=0", "transport.max_bounces", "greater than or equal to 1"),
        ("transport.looks=[{a=2.0}]", "transport.looks.0.a", "less than or equal to 1"),
        ("transport.looks=[{}, {}]", "transport", "two looks have one name"),
        ("transport.method", "--set", "write section.key=value"),
    ],
)
def test_each_wrong_value_is_one_line_that_names_field_and_mend(
    shot_file: Path, setting: str, field: str, said: str
) -> None:
    line = refusal(shot_file, setting)
    assert field in line
    assert said in line


def test_a_line_counts_the_other_troubles_alone(shot_file: Path) -> None:
    assert "more)" not in refusal(shot_file, "volumes.0.extinction=-1")
    assert "more)" not in refusal(shot_file, "transport.looks=[{a=2.0}]")
    two = ["volumes.0.extinction=-1", "transport.looks=[]"]
    assert "volumes.0.extinction" in (line := refusal(shot_file, *two))
    assert line.endswith("(and 1 more)")


def test_orders_need_an_end(shot_file: Path) -> None:
    settings = ["image.orders=true", "transport={method='reference'}"]
    assert "image.orders: orders need an end" in refusal(shot_file, *settings)


def test_contrast_that_never_fades_is_a_warning(shot_file: Path) -> None:
    shot = load_shot(shot_file, ["transport.method=contrast"])
    assert ["transport.looks.0.b = 1" in line for line in shot.warnings()] == [True]
    assert not load_shot(shot_file).warnings()


@pytest.mark.parametrize(("name", "text"), [("a.toml", "x = ["), ("a.json", "{"), ("b.json", "[]")])
def test_a_file_that_is_no_shot(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    assert name in refusal(tmp_path / name)


def test_a_missing_shot_file(tmp_path: Path) -> None:
    assert "no such file" in refusal(tmp_path / "nowhere.toml")


def test_a_missing_cache_and_a_gap_in_the_sequence(shot_file: Path, tmp_path: Path) -> None:
    shot = load_shot(shot_file)
    with pytest.raises(InputError, match=r"volumes\.0\.cache: no such file .*cloud\.0001\.vdb"):
        check_files(shot, "shot.json", shot.frame_numbers)
    (tmp_path / "caches").mkdir()
    for frame in (1, 3):
        (tmp_path / "caches" / f"cloud.{frame:04d}.vdb").touch()
    with pytest.raises(InputError, match=r"gap of 1 of 3 frames, first .*cloud\.0002\.vdb"):
        check_files(shot, "shot.json", shot.frame_numbers)


def test_an_unwritable_output(shot_file: Path, tmp_path: Path) -> None:
    (tmp_path / "caches").mkdir()
    (tmp_path / "caches" / "cloud.0001.vdb").touch()
    (tmp_path / "file").touch()
    shot = load_shot(shot_file, [f"image.output={tmp_path}/file/a.####.exr"])
    with pytest.raises(InputError, match=r"image\.output: cannot write in .*file"):
        check_files(shot, "shot.json", [1])


@pytest.mark.parametrize("field", ["volumes.0.cache", "lights.1.texture", "image.output"])
def test_a_path_that_the_system_refuses_to_look_at(
    shot_file: Path, tmp_path: Path, field: str
) -> None:
    (tmp_path / "caches").mkdir()
    (tmp_path / "caches" / "cloud.0001.vdb").touch()
    shot = load_shot(shot_file, [f"{field}={'x' * 300}.####.exr"])
    with pytest.raises(InputError, match=f"^shot.json: {field}: file name too long: .*xxx"):
        check_files(shot, "shot.json", [1])


@pytest.mark.parametrize(
    "example", sorted(Path(__file__).parents[1].glob("examples/*.toml")), ids=lambda path: path.stem
)
def test_each_example_is_a_shot(example: Path) -> None:
    assert not load_shot(example).warnings()
