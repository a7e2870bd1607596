"""Pileus itself, in a process like its peers'."""

from typing import Any

import numpy as np
import pileus_core as core

from pileus_bench.renderers.protocol import Image, serve
from pileus_service.shot import Shot
from pileus_worker import deciding, scene


class Pileus:
    about = f"Pileus {core.__version__}"

    def load(self, view: dict[str, Any]) -> None:
        self._shot = Shot.model_validate(view["shot"])
        self._frame = int(view["frame"])
        volume = core.Volume(view["cache"], view["grid"])
        self._volume = volume
        self._scene = scene.make_scene(self._shot, self._frame, volume)

    def render(self, settings: dict[str, Any], samples: int, seed: int) -> Image:
        image = self._shot.image
        asked = self._shot.transport.model_copy(update=settings["transport"])
        shot = self._shot.model_copy(update={"transport": asked})
        threads, control = settings.get("threads", 0), core.Control()
        resolved = deciding.resolve(
            shot, self._frame, lambda: self._volume, threads=threads, control=control
        )
        partial = core.render(
            self._scene,
            scene.make_transport(shot, resolved),
            bucket=(0, 0, image.width, image.height),
            samples=(0, samples),
            seed=seed,
            frame=self._frame,
            threads=threads,
            control=control,
        )
        channels = partial.channels(asked.looks[0].name)
        return np.stack([channels[c] for c in "RGB"], axis=-1)


if __name__ == "__main__":
    serve(Pileus)
