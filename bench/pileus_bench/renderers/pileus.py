"""Pileus itself, in a process like its peers'."""

from typing import Any

import pileus_core as core

from pileus_bench.renderers.protocol import Image, serve
from pileus_service.shot import Shot, Transport
from pileus_worker import deciding, machine, scene
from pileus_worker.denoising import denoise
from pileus_worker.sampling import Sampler


class Pileus:
    about = f"Pileus {core.__version__}"

    def load(self, view: dict[str, Any]) -> None:
        self._shot = Shot.model_validate(view["shot"])
        self._frame = int(view["frame"])
        volume = core.Volume(view["cache"], view["grid"])
        self._volume = volume
        self._scene = scene.make_scene(self._shot, self._frame, volume)

    def render(self, settings: dict[str, Any], samples: int, seed: int) -> Image:
        """With a `tolerance` no more samples than that takes; `denoise` filters the frame."""
        shot, tolerance = self._shot, settings.get("tolerance")
        shot = shot.model_copy(
            update={
                "transport": Transport.model_validate(
                    shot.transport.model_dump() | settings["transport"]
                ),
                "sampling": shot.sampling.model_copy(
                    update={"samples": samples, "seed": seed, "tolerance": tolerance}
                ),
                "image": shot.image.model_copy(update={"denoise": settings.get("denoise", False)}),
            }
        )
        threads, control = settings.get("threads", 0), core.Control()
        self.resolved = deciding.resolve(
            shot, self._frame, lambda: self._volume, threads=threads, control=control
        )
        frame = Sampler(
            self._scene, shot, self.resolved, frame=self._frame, threads=threads, control=control
        ).whole()
        self.samples = frame.mean_samples
        denoise(frame, shot, threads or machine.cores())
        return frame.pixels(shot.transport.looks[0].name)[..., :3]


if __name__ == "__main__":
    serve(Pileus)
