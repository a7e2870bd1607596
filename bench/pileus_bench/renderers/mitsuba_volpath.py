"""Mitsuba 3: `volpath` over the same voxels as a dense grid.

Mitsuba's values sit at the centres of its grid's cells, so its box is the samples' box widened by
half a voxel. Roulette caps survival at 0.95, which costs variance where nothing is absorbed: there
it begins late.
"""

import os
from ctypes.util import find_library
from typing import Any

import numpy as np

from pileus_bench.renderers.protocol import Image, serve


class Mitsuba:
    def __init__(self) -> None:
        library = find_library("LLVM-19")
        if library:
            os.environ.setdefault("DRJIT_LIBLLVM_PATH", library)
        import mitsuba

        self._mitsuba: Any = mitsuba
        self._llvm = _llvm_works(mitsuba)
        self.about = f"Mitsuba {mitsuba.__version__} ({'LLVM' if self._llvm else 'scalar, slow'})"
        self._scene: Any = None

    def load(self, view: dict[str, Any]) -> None:
        mi = self._mitsuba
        grey = all(len(set(colour)) == 1 for colour in _colours(view))
        mi.set_variant(("llvm_ad_mono" if grey else "llvm_ad_rgb") if self._llvm else "scalar_rgb")
        self._scene = mi.load_dict(_scene(mi, view, grey))
        self.render({}, 1, 0)  # compiles

    def render(self, settings: dict[str, Any], samples: int, seed: int) -> Image:
        mi = self._mitsuba
        image = np.asarray(mi.render(self._scene, spp=samples, seed=seed), dtype=np.float32)
        return np.repeat(image, 3, axis=-1) if image.shape[-1] == 1 else image[..., :3]


def _llvm_works(mitsuba: Any) -> bool:
    try:
        mitsuba.set_variant("llvm_ad_mono")
        import drjit

        return float((drjit.arange(mitsuba.Float, 4) + 1)[0]) == 1.0
    except Exception:
        return False


def _colours(view: dict[str, Any]) -> list[list[float]]:
    lights = [light.get("irradiance") or light["radiance"] for light in view["lights"]]
    return [view["albedo"], *lights]


def _scene(mi: Any, view: dict[str, Any], grey: bool) -> dict[str, Any]:
    def colour(values: list[float]) -> Any:
        return values[0] if grey else {"type": "rgb", "value": values}

    voxels = np.load(view["voxels"])
    # For row vectors; a voxel's value sits at its whole coordinates, half a voxel inside the box.
    to_world = np.array(view["index_to_world"]).reshape(4, 4).T
    sides = voxels.shape[::-1]
    widen = np.diag([*sides, 1.0])
    widen[:3, 3] = -0.5
    box = mi.ScalarTransform4f(to_world @ widen)
    albedo = view["albedo"]
    camera = view["camera"]
    scene: dict[str, Any] = {
        "type": "scene",
        "fog": {
            "type": "heterogeneous",
            "sigma_t": {
                "type": "gridvolume",
                "grid": mi.VolumeGrid(voxels[..., None]),
                "to_world": box,
                "filter_type": "trilinear",
                "wrap_mode": "clamp",
            },
            "scale": view["extinction"],
            "albedo": colour(albedo),
            "phase": {"type": "hg", "g": view["anisotropy"]},
        },
        "integrator": {
            "type": "volpath",
            "max_depth": -1,
            "rr_depth": 8 if max(albedo) < 0.95 else 65536,
        },
        "sensor": {
            "type": "perspective",
            "fov": camera["fov"],
            "fov_axis": "x",
            "near_clip": 1e-4,
            "to_world": mi.ScalarTransform4f().look_at(
                camera["position"], camera["look_at"], camera["up"]
            ),
            "film": {
                "type": "hdrfilm",
                "width": view["width"],
                "height": view["height"],
                "pixel_format": "luminance" if grey else "rgb",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent"},
        },
        "volume": {
            "type": "cube",
            "to_world": box @ mi.ScalarTransform4f().translate(0.5).scale(0.5),
            "bsdf": {"type": "null"},
            "interior": {"type": "ref", "id": "fog"},
        },
    }
    for index, light in enumerate(view["lights"]):
        if light["type"] == "distant":
            scene[f"light{index}"] = {
                "type": "directional",
                "direction": light["direction"],
                "irradiance": colour(light["irradiance"]),
            }
        else:
            scene[f"light{index}"] = {"type": "constant", "radiance": colour(light["radiance"])}
    if view["inside"]:
        scene["sensor"]["medium"] = {"type": "ref", "id": "fog"}
    return scene


if __name__ == "__main__":
    serve(Mitsuba)
