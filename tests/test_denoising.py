"""Denoised frames: nearer to the truth, with nothing else of them changed."""

import subprocess
import sys
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pileus_core as core
import pytest
from numpy.typing import NDArray

from pileus_service.shot import Shot
from pileus_worker import scene
from pileus_worker.denoising import Filter, Quality, denoise, guide_of

pytest.importorskip("pyoidn", reason="Open Image Denoise has no wheel for this machine")

Channels = dict[str, NDArray[np.float32]]
PILEUS = str(Path(sys.executable).with_name("pileus"))


@pytest.fixture
def noisy(tmp_path: Path, shot: dict[str, Any]) -> Shot:
    """One frame of few samples, with two looks and all channels."""
    (tmp_path / "caches").mkdir()
    core.make_cloud(str(tmp_path / "caches" / "cloud.0001.vdb"), frame=1, frames=2, resolution=64)
    shot["frames"] = "1"
    shot["image"] |= {"width": 128, "height": 72, "orders": True, "denoise": True}
    shot["transport"]["looks"] = [{"name": "hero", "a": 0.65, "b": 0.65, "c": 0.5}, {"name": "own"}]
    return Shot.model_validate(shot)


def changed(shot: Shot, section: str, **values: Any) -> Shot:
    part = getattr(shot, section).model_copy(update=values)
    return shot.model_copy(update={section: part})


def rendered(shot: Shot, file: Path, threads: int = 2) -> dict[str, Channels]:
    """Each look's channels, as `pileus render` writes them."""
    (file.parent / "shot.json").write_text(
        changed(shot, "image", output=str(file)).model_dump_json()
    )
    command = [PILEUS, "render", str(file.parent / "shot.json"), "--threads", str(threads)]
    subprocess.run(command, check=True, capture_output=True)
    return {look: dict(channels) for look, channels in core.read_image(str(file)).items()}


def rel_mse(image: Channels, truth: Channels, prefix: str = "") -> float:
    error = [(image[prefix + c] - truth[c]) ** 2 / (truth[c] ** 2 + 0.01) for c in "RGB"]
    return float(np.mean(error))


def test_colours_come_nearer_to_the_truth_and_nothing_else_changes(
    noisy: Shot, tmp_path: Path
) -> None:
    denoised = rendered(noisy, tmp_path / "denoised.exr")
    plain = rendered(changed(noisy, "image", denoise=False), tmp_path / "plain.exr")
    few = changed(noisy, "image", denoise=False, orders=False)
    truth = rendered(changed(few, "sampling", samples=64, seed=8), tmp_path / "truth.exr")
    for look, channels in plain.items():
        own = denoised[look]
        assert own.keys() == channels.keys() | {"noisy.R", "noisy.G", "noisy.B"}
        for name, values in channels.items():
            kept = f"noisy.{name}" if name in "RGB" else name
            np.testing.assert_array_equal(own[kept], values, f"{look} {name}")
        assert rel_mse(own, truth[look]) < 0.2 * rel_mse(own, truth[look], "noisy.")
    assert not np.array_equal(denoised["hero"]["R"], denoised["own"]["R"])


def test_neither_threads_nor_other_looks_change_a_bit(noisy: Shot, tmp_path: Path) -> None:
    both = rendered(noisy, tmp_path / "both.exr")
    alone = changed(noisy, "transport", looks=noisy.transport.looks[1:])
    [one] = rendered(alone, tmp_path / "alone.exr", threads=1).values()
    for name, values in one.items():
        np.testing.assert_array_equal(both["own"][name], values, name)


def test_each_look_is_told_of_so_that_many_large_ones_are_no_hang(noisy: Shot) -> None:
    shot, size = changed(noisy, "image", width=9, height=7, orders=False), (9, 7)
    view = scene.make_scene(shot, 1, core.Volume(str(scene.cache_path(shot, 1))))
    transport = core.Transport(method="single", looks=scene.make_looks(shot))
    frame = core.Frame(*size, [((0, 0, *size), 1)])
    frame.add(core.render(view, transport, bucket=(0, 0, *size), samples=(0, 1), seed=1, frame=1))
    told: list[int] = []
    denoise(frame, shot, 1, lambda: told.append(1))
    assert len(told) == len(shot.transport.looks)


@pytest.mark.parametrize("size", [(1, 1), (3, 200)])
def test_images_of_any_shape_are_denoised(
    noisy: Shot, tmp_path: Path, size: tuple[int, int]
) -> None:
    shot = changed(noisy, "image", width=size[0], height=size[1])
    for channels in rendered(shot, tmp_path / "odd.exr").values():
        assert channels["R"].shape == size[::-1]
        assert all(np.isfinite(channels[c]).all() and (channels[c] >= 0).all() for c in "RGB")


@pytest.mark.parametrize("quality", get_args(Quality))
@pytest.mark.parametrize("size", [(1, 1), (200, 3), (64, 48), (56, 40)])
def test_nothing_from_beyond_the_image_is_drawn_in(size: tuple[int, int], quality: Quality) -> None:
    ripple = np.where(np.indices(size).sum(axis=0) % 2, 1.0, 1.01)[..., np.newaxis]
    color = np.asarray(ripple * [0.2, 0.3, 0.5], np.float32)
    guide = np.full((*size, 3), 0.5, np.float32)
    found = Filter(2)({"color": color, "albedo": guide}, quality)
    np.testing.assert_allclose(found, color, rtol=0.04)


def test_a_plain_sky_is_left_as_it_is_and_what_stands_in_it_is_the_same_anywhere() -> None:
    noise = np.random.default_rng(4).exponential(size=(30, 21, 3)).astype(np.float32)
    sky = np.array([0.2, 0.3, 0.5], np.float32)
    filtered = []
    for row, column in [(20, 20), (47, 33)]:
        color, guide = (np.tile(of, (100, 90, 1)).astype(np.float32) for of in (sky, [0.5] * 3))
        place = np.s_[row : row + 30, column : column + 21]
        color[place], guide[place] = noise, 1.0
        found = Filter(2)({"albedo": guide, "color": color}, "FAST")
        filtered.append(found[place].copy())
        found[place] = color[place]
        np.testing.assert_array_equal(found, color)
    np.testing.assert_array_equal(filtered[0], filtered[1])
    assert np.var(filtered[0]) < 0.1 * np.var(noise)
    alone = np.broadcast_to(sky, (5, 7, 3))
    np.testing.assert_array_equal(Filter(1)({"color": alone, "albedo": alone}, "FAST"), alone)


@pytest.mark.parametrize(
    ("sampling", "quality"),
    [
        ({"samples": 4}, "FAST"),
        ({"samples": 5}, "HIGH"),
        ({"samples": 8, "tolerance": 0.04}, "FAST"),
        ({"samples": 8, "tolerance": 0.039}, "HIGH"),
    ],
)
def test_the_fast_network_is_taken_where_the_shot_asks_for_little(
    noisy: Shot, tmp_path: Path, sampling: dict[str, Any], quality: Quality
) -> None:
    shot = changed(noisy, "sampling", **sampling)
    hero = rendered(shot, tmp_path / "denoised.exr")["hero"]
    color = np.stack([hero[f"noisy.{c}"] for c in "RGB"], axis=-1)
    images = {"color": color, "albedo": guide_of(hero["A"])}
    own = np.stack([hero[c] for c in "RGB"], axis=-1)
    by_quality = {each: Filter(2)(images, each) for each in get_args(Quality)}
    np.testing.assert_array_equal(own, by_quality[quality])
    assert not np.array_equal(by_quality["FAST"], by_quality["HIGH"])


def test_the_tolerance_is_that_of_the_denoised_image(noisy: Shot, tmp_path: Path) -> None:
    """It is met with fewer samples than the rendered image would take, on each look."""
    sampling = {"samples": 4096, "tolerance": 0.06}
    shot = changed(changed(noisy, "image", orders=False), "sampling", **sampling)
    plain = changed(shot, "image", denoise=False)
    truth = rendered(changed(plain, "sampling", samples=2048, tolerance=None), tmp_path / "t.exr")
    for seed in (1, 2, 3):
        own = rendered(changed(shot, "sampling", seed=seed), tmp_path / "denoised.exr")
        more = rendered(changed(plain, "sampling", seed=seed), tmp_path / "plain.exr")
        for look, channels in own.items():
            assert rel_mse(channels, truth[look]) <= 0.06**2, look
            assert rel_mse(channels, truth[look], "noisy.") > 2 * rel_mse(more[look], truth[look])


def test_a_haze_that_one_sample_shows_takes_one(noisy: Shot, tmp_path: Path) -> None:
    thin = noisy.volumes[0].model_copy(update={"extinction": 0.3})
    shot = changed(noisy, "sampling", samples=4096, tolerance=0.1)
    shot = shot.model_copy(update={"volumes": (thin,)})
    own = rendered(shot, tmp_path / "denoised.exr")
    plain = rendered(changed(shot, "image", denoise=False), tmp_path / "plain.exr")
    one = changed(shot, "sampling", samples=1, tolerance=None)
    alone = rendered(changed(one, "image", denoise=False), tmp_path / "one.exr")
    for look, channels in own.items():
        np.testing.assert_array_equal(channels["noisy.R"], plain[look]["R"])
        np.testing.assert_array_equal(channels["A"], alone[look]["A"])


def test_partials_serve_with_a_filter_and_without_unless_it_sets_their_samples(
    noisy: Shot,
) -> None:
    def identities(shot: Shot) -> set[str]:
        both = [changed(shot, "image", denoise=denoise) for denoise in (False, True)]
        return {scene.identity(each, 1, []) for each in both}

    assert len(identities(noisy)) == 1
    assert len(identities(changed(noisy, "sampling", tolerance=0.1))) == 2


@pytest.mark.parametrize("samples", [1, 5])
def test_samples_that_run_out_are_told(noisy: Shot, tmp_path: Path, samples: int) -> None:
    shot = changed(noisy, "sampling", samples=samples, tolerance=1e-3)
    file = tmp_path / "shot.json"
    file.write_text(changed(shot, "image", output=str(tmp_path / "a.exr")).model_dump_json())
    ended = subprocess.run([PILEUS, "render", str(file)], capture_output=True, text=True)
    assert ended.returncode == 0
    assert "4 of its buckets have had all the samples they may have" in ended.stderr


def test_the_guide_spreads_the_opacity_and_keeps_its_mean() -> None:
    opacity = np.zeros((5, 6), np.float32)
    opacity[2, 3] = 1.0
    guide = guide_of(opacity)
    assert guide.shape == (5, 6, 3)
    kernel = np.outer([1, 2, 1], [1, 2, 1]) / 16
    for channel in range(3):
        np.testing.assert_allclose(guide[1:4, 2:5, channel], (1 + kernel) / 2)
        np.testing.assert_allclose(guide[..., channel].sum(), (30 + 1) / 2)
    np.testing.assert_array_equal(guide_of(np.ones((1, 1), np.float32)), 1.0)


def test_where_the_denoiser_is_missing_a_line_says_so_before_anything_is_rendered(
    noisy: Shot, tmp_path: Path
) -> None:
    file = tmp_path / "shot.json"
    file.write_text(noisy.model_dump_json())
    program = f"""
import sys
sys.modules["pyoidn"] = None
sys.argv = ["pileus", "render", {str(file)!r}]
from pileus_service.cli import main
main()
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert f"{file}: image.denoise: " in ended.stderr
    assert "pip install 'pileus[denoise]'" in ended.stderr
    assert not (tmp_path / "out").exists()
