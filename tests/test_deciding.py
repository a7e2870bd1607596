"""`auto`: its promise against a quiet truth, the model it takes, its calm along a sequence."""

import argparse
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pileus_core as core
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pileus_bench import promise
from pileus_bench.here import ready
from pileus_bench.measures import error
from pileus_bench.scenes import SHARED, scene_names
from pileus_service.jobs import Resolved
from pileus_service.shot import Shot
from pileus_worker import deciding, scene
from pileus_worker.deciding import PILOT_ORDERS, Measure, Seen, decide
from pileus_worker.sampling import Sampler

SIZE = 48
SEEDS = range(5)


def auto(shot: dict[str, Any], cache: Path, tolerance: float, **volume: Any) -> Shot:
    return Shot.model_validate(
        shot
        | {
            "frames": "1",
            "image": shot["image"] | {"width": SIZE, "height": SIZE},
            "volumes": [shot["volumes"][0] | {"cache": str(cache)} | volume],
            "transport": {"method": "auto"},
            "sampling": {"samples": 4096, "tolerance": tolerance},
        }
    )


def red(shot: Shot, volume: core.Volume, method: core.Transport, samples: int) -> Any:
    partial = core.render(
        scene.make_scene(shot, 1, volume),
        method,
        bucket=(0, 0, SIZE, SIZE),
        samples=(0, samples),
        seed=99,
        frame=1,
    )
    return partial.channels("beauty")["R"].astype(np.float64)


@pytest.mark.parametrize(
    ("volume", "tolerance", "method"),
    [
        pytest.param({"extinction": 60.0, "anisotropy": 0.85}, 0.1, "similarity", id="cumulus"),
        pytest.param({"extinction": 0.3, "anisotropy": 0.6}, 0.1, "reference", id="haze"),
        pytest.param(
            {"extinction": 20.0, "anisotropy": 0.0, "albedo": (0.8, 0.8, 0.8)},
            0.1,
            "reference",
            id="absorbing",
        ),
    ],
)
def test_the_tolerance_is_kept_by_the_smallest_model(
    shot: dict[str, Any],
    tmp_path: Path,
    volume: dict[str, Any],
    tolerance: float,
    method: str,
) -> None:
    cache = tmp_path / "cloud.vdb"
    core.make_cloud(str(cache), frame=1, frames=3, resolution=48)
    field = core.Volume(str(cache))
    wanted = auto(shot, cache, tolerance, **volume)
    truth = red(wanted, field, core.Transport(method="reference", looks=[_beauty()]), 1024)
    for resolved in kept(wanted, field, truth):
        assert resolved.method == method, resolved.reason
        assert (resolved.max_bounces == 1) == (volume["extinction"] < 1), resolved.reason


def kept(wanted: Shot, field: core.Volume, truth: Any) -> Iterator[Resolved]:
    """What is decided with each seed; the tolerance is kept with all of them."""
    for seed in SEEDS:
        sampling = wanted.sampling.model_copy(update={"seed": seed})
        ours = wanted.model_copy(update={"sampling": sampling})
        control = core.Control()
        resolved = deciding.resolve(ours, 1, lambda: field, threads=0, control=control)
        view = scene.make_scene(ours, 1, field)
        sampler = Sampler(view, ours, resolved, frame=1, threads=0, control=control)
        image = sampler.whole().pixels("beauty")[..., 0]
        rms = math.sqrt(np.mean((image - truth) ** 2 / (truth**2 + 0.01)))
        assert rms <= (ours.sampling.tolerance or 0.0), resolved.reason
        yield resolved


def test_where_similarity_errs_by_more_than_is_usual_the_pilot_sees_it(
    shot: dict[str, Any], tmp_path: Path
) -> None:
    """Light that comes from behind through an even fog. Reduced from event 3 on it is 8 % too
    much, where a cloud's errs by 3 %."""
    cache = tmp_path / "fog.vdb"
    side = 32
    fog = np.ones((side, side, side), np.float32)
    core.write_grid(str(cache), [((0, 0, 0), fog)], voxel=(1 / side,) * 3, origin=(-0.5,) * 3)
    field = core.Volume(str(cache))
    behind = {
        "camera": {"position": [0, 0, 2], "look_at": [0, 0, 0], "fov": 35.0},
        "lights": [{"type": "distant", "direction": [0, 0.2, 1], "irradiance": [3, 3, 3]}],
    }
    wanted = auto(shot | behind, cache, 0.1, extinction=6.0, anisotropy=0.6)

    def brightness(method: str, **more: int) -> float:
        transport = core.Transport(method=method, looks=[_beauty()], **more)
        return float(red(wanted, field, transport, 256).mean())

    truth = brightness("reference")
    assert brightness("similarity", reduce_from=3) > 1.06 * truth
    assert brightness("similarity", reduce_from=6) < 1.03 * truth
    large = wanted.image.model_copy(update={"width": 4 * SIZE, "height": 4 * SIZE})
    for seed in SEEDS:
        sampling = wanted.sampling.model_copy(update={"seed": seed})
        ours = wanted.model_copy(update={"sampling": sampling, "image": large})
        resolved = deciding.resolve(ours, 1, lambda: field, threads=0, control=core.Control())
        assert (resolved.method, resolved.reduce_from) == ("similarity", 6), resolved.reason


@pytest.mark.slow
@pytest.mark.parametrize("denoise", [False, True])
def test_the_promise_holds_on_the_charts_scenes(tmp_path: Path, denoise: bool) -> None:
    """As `python -m pileus_bench.promise` prints it: five seeds, in 95 % of renders."""
    asked = argparse.Namespace(
        scenes=",".join(scene_names()), scale=0.5, data=tmp_path, shared=SHARED
    )
    if denoise:
        pytest.importorskip("pyoidn")
    settings = promise.AUTO | {"tolerance": 0.05, "denoise": denoise}
    held = [
        error(renderer.timed(settings, promise.MOST_SAMPLES, seed)[0], truth) <= 0.05**2
        for _, renderer, truth in ready(asked)
        for seed in promise.SEEDS
    ]
    assert len(held) >= 9 * len(promise.SEEDS)
    assert np.mean(held) >= 0.95


def _beauty() -> core.Look:
    return core.Look(name="beauty")


def unseen(start: int) -> Seen:
    return Seen(0.0, 0.0)


@given(st.lists(st.floats(0.96, 1.04), min_size=2, max_size=12))
def test_a_measure_that_wavers_about_a_limit_flips_nothing(wavering: list[float]) -> None:
    """Along a sequence the decision holds while the measure stays within a few per cent of where
    one model gives way to the next, on either side."""
    shot = Shot.model_validate(
        {
            "name": "wavering",
            "frames": "1-9",
            "image": {"width": 8, "height": 8, "output": "a.####.exr"},
            "volumes": [{"cache": "a.####.vdb", "extinction": 1.0, "anisotropy": 0.8}],
            "camera": {"position": [0, 0, 2], "look_at": [0, 0, 0]},
            "transport": {"method": "auto"},
            "sampling": {"samples": 64, "tolerance": 0.1},
        }
    )
    orders = np.arange(PILOT_ORDERS + 1, dtype=np.float64)
    # An eighth of the tolerance is left out by single scattering, or after seven orders.
    at_single = 0.0125 * np.exp2(1.0 - orders)
    at_seven = 0.0125 * np.exp2((7.0 - orders) / 3.0)
    # With little noise single scattering may leave out half of what one sample's leaves.
    quiet = 0.04
    at_quiet = (0.1 - quiet) / 2 * np.exp2(1.0 - orders)
    for tail, noise in ((at_single, math.inf), (at_seven, math.inf), (at_quiet, quiet)):
        first = decide(shot, Measure(tail * wavering[0], noise=noise * wavering[0]), unseen)
        for factor in wavering[1:]:
            later = decide(shot, Measure(tail * factor, noise=noise * factor), unseen, first)
            assert (later.method, later.max_bounces) == (first.method, first.max_bounces)
    # Three fifths of it may be similarity's bias, if the pilot sees that it is no less.
    deep = Measure(np.full(PILOT_ORDERS + 1, 1.0))
    for bias, spread in ((0.06, 0.0), (0.06, 0.03), (0.08, 0.038), (0.2, 0.158)):

        def seen(factor: float, bias: float, spread: float) -> Callable[[int], Seen]:
            return lambda start: (
                Seen(bias * factor, spread * factor) if start < 6 else unseen(start)
            )

        first = decide(shot, deep, seen(wavering[0], bias, spread))
        for factor in wavering[1:]:
            later = decide(shot, deep, seen(factor, bias, spread), first)
            assert later.reduce_from == first.reduce_from
