"""The chart: bias and noise are told apart, and a scene's points come out as they must."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pileus_core as core
import pytest

from pileus_bench.art_directed import against_single
from pileus_bench.contenders import PEERS, methods
from pileus_bench.measures import Truth, errors, relative_noise
from pileus_bench.process import RendererProcess
from pileus_bench.run import Measurement, Plan
from pileus_bench.scenes import AbsentError, dense, load_scene, scene_names
from pileus_service.shotfile import load_shot

TINY = Plan(
    budgets=(0.05,),
    tolerances=(0.1,),
    repeats=3,
    truth_noise=1e-4,
    truth_seconds=2.0,
    scale=0.25,
)


@pytest.mark.parametrize(("bias", "noise", "truth_noise"), [(0.05, 0.1, 0.02), (0.0, 0.2, 0.05)])
def test_bias_and_noise_are_told_apart_whatever_the_truths_own_noise(
    bias: float, noise: float, truth_noise: float
) -> None:
    """Made images around a known one: the estimates must find what was put in."""
    random = np.random.default_rng(7)
    exact = random.uniform(0.5, 1.5, (160, 240, 1)).repeat(3, axis=2)

    def seen(spread: float, factor: float = 1.0) -> np.ndarray:
        return exact * factor * (1 + spread * random.standard_normal(exact.shape))

    truth = Truth(seen(truth_noise), seen(truth_noise))
    found = errors([([seen(noise, 1 + bias) for _ in range(4)], truth)])
    relative = np.mean(exact**2 / (exact**2 + 0.01))
    assert found.noise == pytest.approx(((1 + bias) * noise) ** 2 * relative, rel=0.05)
    assert found.bias.value == pytest.approx(bias**2 * relative, abs=1e-4)
    assert found.rel_mse.value == pytest.approx(found.noise + found.bias.value, rel=0.05)
    assert (found.bias.low > 0) == (bias > 0)
    assert found.mean_ratio == pytest.approx(1 + bias, abs=4 * found.mean_ratio_error)


def test_a_method_has_no_less_noise_for_being_darker() -> None:
    random = np.random.default_rng(9)
    exact = random.uniform(0.0, 1.0, (100, 100, 1)).repeat(3, axis=2)
    renders = [exact * (1 + 0.1 * random.standard_normal(exact.shape)) for _ in range(3)]
    dark = [render / 40 for render in renders]
    truth = Truth(exact, exact)
    assert relative_noise(dark, truth) == pytest.approx(relative_noise(renders, truth))
    assert relative_noise(renders, truth) == pytest.approx(
        errors([(renders, truth)]).noise, rel=0.1
    )


def test_a_few_fireflies_do_not_decide() -> None:
    random = np.random.default_rng(8)
    exact = np.ones((100, 100, 3))
    truth = Truth(exact, exact)
    renders = [exact + 0.1 * random.standard_normal(exact.shape) for _ in range(3)]
    calm = errors([(renders, truth)])
    for render in renders:
        render[random.integers(100, size=9), random.integers(100, size=9)] = 1e4
    wild = errors([(renders, truth)])
    assert wild.rel_mse.value > 1000
    assert wild.trimmed.value == pytest.approx(calm.trimmed.value, rel=0.02)


def test_every_scene_is_a_shot(tmp_path: Path) -> None:
    import pileus_bench.scenes as module

    assert len(scene_names()) >= 10
    animated = 0
    for name in scene_names():
        shot = load_shot(module.SCENES / f"{name}.toml")
        animated += len(shot.frame_numbers) > 1
    assert animated >= 2
    with pytest.raises(AbsentError, match="cumulus256"):
        load_scene("cumulus", 0.25, tmp_path, tmp_path)


def test_a_scene_is_measured_and_its_truth_kept(tmp_path: Path) -> None:
    notes: list[str] = []
    bare = str(Path(sys.base_prefix) / "bin" / "python3")
    pythons = {each.renderer: bare for each in PEERS} | {"pileus": sys.executable}
    with Measurement(TINY, tmp_path, pythons, notes.append) as measurement:
        wanted = [each for each in methods() if each.name in ("single", "reference")]
        # That interpreter has no peers: a line each, and the rest goes on.
        contenders = measurement.start([*wanted, *PEERS])
        assert contenders == wanted
        assert len(measurement.skipped) == 2
        scene = load_scene("smoke", TINY.scale, tmp_path, tmp_path)
        measurement.scene(scene, contenders)
        single, reference = measurement.points
        assert single.bias.low > 0.001, "smoke without its multiple scattering"
        assert single.mean_ratio < 1 - 4 * single.mean_ratio_error
        assert reference.bias.low <= 0.001
        assert reference.mean_ratio == pytest.approx(1, abs=5 * reference.mean_ratio_error)

        kept = list((tmp_path / "truths").iterdir())
        assert len(kept) == 1
        before = kept[0].stat().st_mtime_ns
        measurement.scene(scene, contenders)
        assert [file.stat().st_mtime_ns for file in (tmp_path / "truths").iterdir()] == [before]


def test_later_orders_cost_noise_under_a_look_too(tmp_path: Path) -> None:
    with RendererProcess("pileus", sys.executable) as renderer:
        bar = against_single(renderer, ["sun", "cumulus"], TINY, tmp_path, tmp_path)
    assert bar.values.keys() == {"sun"}, "the cumulus is not here"
    assert bar.mean == pytest.approx(bar.values["sun"])
    assert 2 < bar.values["sun"] < 50


def test_dense_voxels_are_those_that_are_interpolated(tmp_path: Path) -> None:
    """What the peers get is the field that Pileus renders, between the voxels too."""
    path = str(tmp_path / "cloud.vdb")
    core.make_cloud(path, frame=1, frames=1, resolution=24)
    volume = core.Volume(path)
    voxels = dense(volume, 1 / 24)
    assert voxels.max() > 0.9
    low = np.asarray((volume.world_bounds or pytest.fail("a cloud is not empty"))[0])
    random = np.random.default_rng(9)
    last = np.array(voxels.shape[::-1]) - 1
    for at in random.uniform(0, last, (500, 3)):
        cell = np.minimum(at.astype(int), last - 1)
        x, y, z = cell
        value = voxels[z : z + 2, y : y + 2, x : x + 2].astype(float)
        for weight in at - cell:  # from the last axis, x, to the first
            value = value[..., 0] * (1 - weight) + value[..., 1] * weight
        assert volume.interpolate(tuple(low + at / 24)) == pytest.approx(float(value), abs=1e-4)


def test_an_unknown_scene_is_one_line(tmp_path: Path) -> None:
    ended = subprocess.run(
        [
            str(Path(sys.executable).with_name("pileus")),
            *("chart", "--scenes", "haze,nothing", "--data", str(tmp_path)),
        ],
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert "nothing" in ended.stderr
