"""`reference` against truths from elsewhere: a stored unbiased render of the cumulus, white
furnaces on real volumes, and, slowly, Mitsuba 3."""

from typing import Any

import numpy as np
import pileus_core
import pytest

from render_fixtures import (
    Image,
    camera_around,
    data_file,
    make_scene,
    render,
    spread,
    tiles,
    z_limit,
)

CONFIDENCE = 0.999


@pytest.mark.parametrize(
    ("samples", "seen"),
    [
        pytest.param(48, 0.03, id="coarse"),
        pytest.param(1024, 0.01, id="fine", marks=pytest.mark.slow),
    ],
)
def test_cumulus_equals_its_stored_render(samples: int, seen: float) -> None:
    """Pixel by pixel, and over squares of pixels; an error of `seen` in one of them would show."""
    volume = pileus_core.Volume(str(data_file("cumulus/cumulus256.vdb")))
    stored = pileus_core.read_image(str(data_file("cumulus/cumulus256_reference.exr")))
    (part,) = stored.values()
    truth = part["R"].astype(np.float64)
    size = 256
    camera = pileus_core.Camera(
        position=(0.15, 0.12, 1.9), look_at=(0, 0.02, 0), up=(0, 1, 0), fov=35
    )
    lights = [
        pileus_core.DistantLight(direction=(0.6, -0.55, -0.58), irradiance=(3.14159,) * 3),
        pileus_core.DomeLight(radiance=(0.3, 0.3, 0.3)),
    ]
    scene = make_scene(volume, camera, lights, extinction=60, anisotropy=0.85, size=size)
    ours = render(scene, "reference", samples, size)
    np.testing.assert_array_equal(ours["R"], ours["B"])  # grey light through a grey medium

    mean_error = np.sqrt(ours["variance.R"].sum()) / ours["R"].sum()
    assert mean_error < 0.0012, "too noisy for what follows"
    assert ours["R"].mean() == pytest.approx(truth.mean(), rel=0.003)

    variance = ours["variance.R"]
    # A pixel may have missed its rarest paths, so its variance is at least its neighbourhood's.
    variance = np.maximum(variance, spread(variance, 2))
    # The stored image's own noise is a relMSE of 5e-4, as is said where it comes from: spread as
    # ours is, and evenly where we met nothing.
    noise = 5e-4
    stored_variance = np.maximum(
        variance * noise / np.mean(variance / (truth**2 + 0.01)), noise * (truth**2 + 0.01)
    )
    sides = (1, 4, 16, 64)

    def worst(image: Image) -> float:
        """The largest difference at any scale, as a part of what chance explains."""
        return max(
            float(np.abs(tiles(image - truth, side) / deviation).max())
            / z_limit(CONFIDENCE, deviation.size)
            for side in sides
            for deviation in [np.sqrt(tiles(variance + stored_variance, side)) / side]
        )

    assert worst(ours["R"]) < 1
    in_cloud = ours["A"] > 0.5
    assert in_cloud.sum() > 10_000
    z = (ours["R"] - truth) / np.sqrt(variance + stored_variance)
    assert np.sqrt(np.mean(z[in_cloud] ** 2)) < 1.1

    square = np.s_[128:192, 128:192]
    assert in_cloud[square].mean() > 0.9
    spoiled = ours["R"].copy()
    spoiled[square] *= 1 + seen
    assert worst(spoiled) > 1, "the test is blind"


@pytest.mark.parametrize(
    ("name", "extinction", "anisotropy"),
    [("cumulus/cumulus256.vdb", 60.0, 0.85), ("smoke/smoke.vdb", 0.5, -0.3)],
)
def test_white_furnace_is_one_at_every_pixel(
    name: str, extinction: float, anisotropy: float
) -> None:
    """Without absorption each path ends in the dome with its whole weight: no noise at all."""
    volume = pileus_core.Volume(str(data_file(name)))
    size = 32
    scene = make_scene(
        volume,
        camera_around(volume),
        [pileus_core.DomeLight(radiance=(1, 1, 1))],
        extinction=extinction,
        anisotropy=anisotropy,
        size=size,
    )
    image = render(scene, "reference", 8, size)
    assert image["A"].mean() > 0.05
    for channel in "RGB":
        np.testing.assert_allclose(image[channel], 1.0, rtol=1e-6)


def mitsuba_render(
    mitsuba: Any, scene: dict[str, Any], samples: int, passes: int
) -> tuple[Image, Image]:
    """The mean of several passes and the variance of that mean."""
    images = [
        np.asarray(mitsuba.render(mitsuba.load_dict(scene), spp=samples, seed=seed))[..., 1]
        for seed in range(passes)
    ]
    stack = np.stack(images).astype(np.float64)
    return stack.mean(axis=0), stack.var(axis=0, ddof=1) / passes


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "voxel", "extinction", "albedo", "anisotropy"),
    [
        pytest.param("smoke/smoke.vdb", 10 / 21, 0.1, 1.0, 0.4, id="thin"),
        pytest.param("c42/fluid_data_0005.vdb", 0.8, 0.6, 0.8, -0.5, id="absorbing, backwards"),
    ],
)
def test_agrees_with_mitsuba(
    name: str, voxel: float, extinction: float, albedo: float, anisotropy: float
) -> None:
    mitsuba: Any = pytest.importorskip("mitsuba")
    # Not LLVM's, which need a library of their own.
    variants = [v for v in ("scalar_mono", "scalar_rgb") if v in mitsuba.variants()]
    mitsuba.set_variant(variants[0])

    volume = pileus_core.Volume(str(data_file(name)))
    size = 32
    assert volume.world_bounds is not None
    # The same voxels as a dense array. Mitsuba's values sit at the centres of its grid's cells: its
    # box is that of the samples, widened by half a voxel.
    low, high = (np.asarray(corner) for corner in volume.world_bounds)
    counts = np.rint((high - low) / voxel).astype(int) + 1
    np.testing.assert_allclose(low + voxel * (counts - 1), high, rtol=1e-5)
    dense = np.zeros(counts[::-1], np.float32)
    for z, y, x in np.ndindex(*dense.shape):
        dense[z, y, x] = volume.interpolate(tuple(low + voxel * np.array([x, y, z])))
    assert dense.max() > 0
    box_low, box_high = low - voxel / 2, low + voxel * (counts - 0.5)
    to_world = (
        mitsuba.ScalarTransform4f().translate(box_low.tolist()).scale((box_high - box_low).tolist())
    )

    centre = (low + high) / 2
    position = centre + np.array([0.5, 0.6, 1.0]) * np.linalg.norm(high - low)
    sun = np.array([0.5, -0.7, 0.3]) / np.linalg.norm([0.5, -0.7, 0.3])
    reference, variance = mitsuba_render(
        mitsuba,
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 1000, "rr_depth": 256},
            "sensor": {
                "type": "perspective",
                "fov": 40.0,
                "fov_axis": "x",
                "to_world": mitsuba.ScalarTransform4f().look_at(
                    position.tolist(), centre.tolist(), [0, 1, 0]
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": size,
                    "height": size,
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent"},
            },
            "volume": {
                "type": "cube",
                "to_world": mitsuba.ScalarTransform4f()
                .translate(((box_low + box_high) / 2).tolist())
                .scale(((box_high - box_low) / 2).tolist()),
                "bsdf": {"type": "null"},
                "interior": {
                    "type": "heterogeneous",
                    "sigma_t": {
                        "type": "gridvolume",
                        "grid": mitsuba.VolumeGrid(dense[..., None]),
                        "to_world": to_world,
                        "filter_type": "trilinear",
                        "wrap_mode": "clamp",
                    },
                    "scale": extinction,
                    "albedo": albedo,
                    "phase": {"type": "hg", "g": anisotropy},
                },
            },
            "sun": {"type": "directional", "direction": sun.tolist(), "irradiance": 2.0},
            "sky": {"type": "constant", "radiance": 0.5},
        },
        samples=64,
        passes=16,
    )

    camera = pileus_core.Camera(
        position=tuple(position), look_at=tuple(centre), up=(0, 1, 0), fov=40
    )
    lights = [
        pileus_core.DistantLight(direction=tuple(sun), irradiance=(2, 2, 2)),
        pileus_core.DomeLight(radiance=(0.5, 0.5, 0.5)),
    ]
    scene = make_scene(
        volume,
        camera,
        lights,
        extinction=extinction,
        albedo=albedo,
        anisotropy=anisotropy,
        size=size,
    )
    ours = render(scene, "reference", 1024, size)
    in_smoke = ours["A"] > 0.02
    assert in_smoke.sum() > 100
    assert ours["R"][in_smoke].mean() == pytest.approx(reference[in_smoke].mean(), rel=0.01)
    z = (ours["R"] - reference)[in_smoke] / np.sqrt(
        (ours["variance.R"] + spread(variance, 1))[in_smoke] + 1e-10
    )
    assert abs(z.sum()) / np.sqrt(z.size) < z_limit(CONFIDENCE)
    # The passes' variance has fifteen degrees of freedom: the limit is a normal's, widened.
    assert np.abs(z).max() < 1.5 * z_limit(CONFIDENCE, z.size)
