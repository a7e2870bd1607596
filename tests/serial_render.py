"""The farm's oracle: a frame's parts rendered one by one, here, and compared bit by bit."""

from pathlib import Path
from typing import Any

import numpy as np
import pileus_core as core

from pileus_service.jobs import Plan
from pileus_service.shot import Shot
from pileus_service.store import Store
from pileus_worker import scene
from pileus_worker.denoising import denoise


def plan_of(data: Path, job: str, frame: int) -> Plan:
    plan = Store(data).frame(job, frame).plan()
    assert plan is not None
    return plan


def rendered_here(shot: Shot, plan: Plan) -> core.Frame:
    """What a farm must write, bit for bit: the plan's parts, rendered one by one."""
    volume = core.Volume(plan.cache.path, shot.volumes[0].density)
    view = scene.make_scene(shot, plan.frame, volume)
    transport = scene.make_transport(shot, plan.transport)
    samples = shot.sampling.samples
    buckets = [*dict.fromkeys(part.bucket for part in plan.parts), *plan.empty]
    size = (shot.image.width, shot.image.height)
    frame = core.Frame(*size, [(bucket, samples) for bucket in buckets])
    parts = [(part.bucket, part.samples) for part in plan.parts]
    parts += [(bucket, (0, samples)) for bucket in plan.empty]
    for bucket, span in parts:
        frame.add(
            core.render(
                view,
                transport,
                bucket=bucket,
                samples=span,
                seed=shot.sampling.seed,
                frame=plan.frame,
            )
        )
    denoise(frame, shot, threads=1)
    return frame


def pixels(path: Path) -> dict[str, np.ndarray[Any, np.dtype[np.float32]]]:
    [channels] = core.read_image(str(path)).values()
    return dict(channels)


def same_bits(shot: Shot, data: Path, job: str, frame: int, scratch: Path) -> None:
    """Asserts that the farm over the folder `data` wrote the very frame that is rendered here."""
    here = rendered_here(shot, plan_of(data, job, frame))
    expected = scratch / f"expected.{frame}.exr"
    here.write(str(expected), header={})
    for name, values in pixels(expected).items():
        np.testing.assert_array_equal(pixels(shot.output(frame))[name], values, name)
    expected.unlink()
