"""Each real file renders, or fails with the one line that names the trouble."""

from pathlib import Path

import numpy as np
import pileus_core
import pytest

from render_fixtures import DATA, camera_around, data_file, make_scene, render

SIZE = 12


def assert_renders(volume: pileus_core.Volume) -> None:
    """A small image of it is finite, not negative, and shows the volume where there is one."""
    if volume.world_bounds is None:
        extinction = 1.0
    else:
        low, high = (np.asarray(corner) for corner in volume.world_bounds)
        extinction = 200.0 / float(np.linalg.norm(high - low))
    lights = [
        pileus_core.DistantLight(direction=(0.3, -1, -0.4), irradiance=(2, 2, 2)),
        pileus_core.DomeLight(radiance=(0.5, 0.5, 0.5)),
    ]
    scene = make_scene(
        volume,
        camera_around(volume),
        lights,
        extinction=extinction,
        albedo=0.9,
        anisotropy=0.5,
        size=SIZE,
    )
    for method in ("multiple", "reference"):
        image = render(scene, method, 16, SIZE)
        for name, values in image.items():
            assert np.isfinite(values).all(), name
            assert (values >= 0).all(), name
        assert (image["A"].max() > 0) == (not volume.empty)


def refusal(path: Path, grid: str) -> str:
    with pytest.raises(pileus_core.InputError) as error:
        pileus_core.Volume(str(path), grid)
    line = str(error.value)
    assert "\n" not in line
    assert str(path) in line
    return line


@pytest.mark.parametrize(
    "name",
    [
        "cumulus/cumulus256.vdb",
        "smoke/smoke.vdb",
        "openusd/densityAndHeat.vdb",
        "openusd/smoke_000002.vdb",
        "openusd/smoke_000003.vdb",
        *(f"c42/fluid_data_{frame:04}.vdb" for frame in range(1, 6)),
    ],
)
def test_densities_render_without_a_word(name: str) -> None:
    volume = pileus_core.Volume(str(data_file(name)))
    assert volume.warnings == []
    assert volume.active_voxels > 0
    assert_renders(volume)


def test_the_empty_frame_warns_and_shows_the_sky() -> None:
    path = data_file("openusd/smoke_000001.vdb")
    volume = pileus_core.Volume(str(path))
    assert volume.empty
    (warning,) = volume.warnings
    assert str(path) in warning
    assert "empty" in warning
    assert_renders(volume)


@pytest.mark.parametrize("frame", [0, 24, 47])
def test_the_unnamed_rising_column_is_asked_for_by_no_name(frame: int) -> None:
    path = data_file(f"stormscape/output_cube_fluid_30_frame_{frame:04}.vdb")
    assert 'no grid "density"' in refusal(path, "density")
    volume = pileus_core.Volume(str(path), "")
    (warning,) = volume.warnings
    assert "negative voxels" in warning
    assert_renders(volume)


def test_the_unnamed_level_set_becomes_fog() -> None:
    path = data_file("levelset/sphere.vdb")
    assert 'no grid "density"' in refusal(path, "density")
    volume = pileus_core.Volume(str(path), "")
    assert any("level set" in warning for warning in volume.warnings)
    assert volume.world_bounds is not None
    low, high = (np.asarray(corner) for corner in volume.world_bounds)
    assert volume.interpolate(tuple((low + high) / 2)) == 1.0
    assert_renders(volume)


def test_a_missing_name_lists_the_grids_of_a_crowded_file() -> None:
    path = data_file("c42/fluid_data_0003.vdb")
    line = refusal(path, "smoke")
    for name in ("density", "temperature", "velocity", "flags"):
        assert f'"{name}' in line
    assert line.count('" (') == 24


@pytest.mark.parametrize("grid", ["velocity", "flags", "phi_obstacle"])
def test_grids_of_a_crowded_file_are_taken_or_refused_by_kind(grid: str) -> None:
    path = data_file("c42/fluid_data_0003.vdb")
    if grid == "phi_obstacle":
        # Distances, with 10^4 for "nowhere": no density, but a scalar; it must do no harm.
        assert_renders(pileus_core.Volume(str(path), grid))
    else:
        assert "must be float or double" in refusal(path, grid)


@pytest.mark.parametrize("name", ["sky", "sunset", "dawn"])
def test_domes_light_a_volume(name: str) -> None:
    texture = data_file(f"env/{name}.exr")
    volume = pileus_core.Volume(str(data_file("openusd/smoke_000003.vdb")))
    dome = pileus_core.DomeLight(radiance=(1, 1, 1), texture=str(texture))
    # Lossy compression left a few texels below zero.
    assert all("negative" in warning and str(texture) in warning for warning in dome.warnings)
    scene = make_scene(volume, camera_around(volume), [dome], extinction=1.0, size=SIZE)
    image = render(scene, "multiple", 4, SIZE)
    assert np.isfinite(image["R"]).all()
    assert image["R"].min() > 0


def test_every_volume_of_the_folder_is_spoken_of() -> None:
    """A new file must find its place in these tests."""
    if not DATA.is_dir():
        pytest.skip("needs ../shared/data")
    known = {"c42", "cumulus", "levelset", "openusd", "smoke", "stormscape"}
    assert {path.parent.name for path in DATA.rglob("*.vdb")} == known
