"""Blender's Cycles 5: reads the cache itself; unbiased or by ray marching, with OIDN or without.

Tuned for these scenes: 1,024 bounces, no clamping, no adaptive sampling, a box filter, full
precision, and data that persists between renders, so that only the first pays for reading.
"""

import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from pileus_bench.renderers.protocol import Image, serve

BOUNCES = 1024


class Cycles:
    def __init__(self) -> None:
        import bpy
        import mathutils

        resources = Path(bpy.utils.resource_path("LOCAL"))
        sys.path += map(str, resources.glob("python/lib/*/site-packages"))
        import OpenImageIO

        self._oiio: Any = OpenImageIO
        self.about = f"Cycles {bpy.app.version_string}"
        self._bpy: Any = bpy
        self._mathutils: Any = mathutils
        self._size = (0, 0)
        self._folder = tempfile.TemporaryDirectory()

    def load(self, view: dict[str, Any]) -> None:
        bpy = self._bpy
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        self._size = view["width"], view["height"]
        _settle(scene, *self._size)
        scene.collection.objects.link(_volume(bpy, view))
        scene.camera = self._camera(view["camera"])
        scene.collection.objects.link(scene.camera)
        scene.world = bpy.data.worlds.new("sky")
        scene.world.use_nodes = True
        sky = scene.world.node_tree.nodes["Background"].inputs
        sky["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
        sky["Strength"].default_value = 1.0
        for light in view["lights"]:
            if light["type"] == "dome":
                sky["Color"].default_value = (*light["radiance"], 1.0)
            else:
                scene.collection.objects.link(self._sun(light))
        # The first render builds the scene, octree and all, and persists; no size less will do.
        scene.render.resolution_x = scene.render.resolution_y = 16
        self._write({"biased": False, "denoise": False}, 1, 0)
        scene.render.resolution_x, scene.render.resolution_y = self._size

    def render(self, settings: dict[str, Any], samples: int, seed: int) -> Image:
        file = self._write(settings, samples, seed)
        # Not into an image of Blender's: that would make it build the scene anew each time.
        found = self._oiio.ImageBuf(str(file)).get_pixels(self._oiio.FLOAT)
        return np.ascontiguousarray(found[..., :3])

    def _write(self, settings: dict[str, Any], samples: int, seed: int) -> Path:
        scene = self._bpy.context.scene
        scene.cycles.samples = samples
        scene.cycles.seed = seed
        scene.cycles.volume_biased = settings["biased"]
        scene.cycles.use_denoising = settings["denoise"]
        scene.cycles.denoiser = "OPENIMAGEDENOISE"
        scene.cycles.denoising_use_gpu = False
        file = Path(self._folder.name) / "image.exr"
        scene.render.filepath = str(file)
        self._bpy.ops.render.render(write_still=True)
        return file

    def _camera(self, camera: dict[str, Any]) -> Any:
        bpy, vector = self._bpy, self._mathutils.Vector
        data = bpy.data.cameras.new("camera")
        data.sensor_fit = "HORIZONTAL"
        data.angle = math.radians(camera["fov"])
        data.clip_start = 1e-4
        back = vector(camera["position"]) - vector(camera["look_at"])
        back.normalize()
        right = vector(camera["up"]).cross(back).normalized()
        place = self._mathutils.Matrix((right, back.cross(right), back)).transposed().to_4x4()
        place.translation = vector(camera["position"])
        found = bpy.data.objects.new("camera", data)
        found.matrix_world = place
        return found

    def _sun(self, light: dict[str, Any]) -> Any:
        bpy, vector = self._bpy, self._mathutils.Vector
        data = bpy.data.lights.new("sun", "SUN")
        data.energy = 1.0
        # A colour may exceed one, and is the irradiance on a plane that faces the sun.
        data.color = light["irradiance"]
        data.angle = math.radians(light["angle"])
        found = bpy.data.objects.new("sun", data)
        found.rotation_mode = "QUATERNION"
        found.rotation_quaternion = vector(light["direction"]).to_track_quat("-Z", "Y")
        return found


def _settle(scene: Any, width: int, height: int) -> None:
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y = width, height
    render.resolution_percentage = 100
    render.use_motion_blur = False
    render.use_persistent_data = True
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_depth = "32"
    render.image_settings.exr_codec = "NONE"
    scene.view_settings.view_transform = "Raw"
    cycles.device = "CPU"
    cycles.use_adaptive_sampling = False
    cycles.pixel_filter_type = "BOX"
    cycles.filter_width = 1.0
    cycles.max_bounces = BOUNCES
    cycles.volume_bounces = BOUNCES
    cycles.sample_clamp_direct = 0.0
    cycles.sample_clamp_indirect = 0.0
    cycles.use_auto_tile = False


def _volume(bpy: Any, view: dict[str, Any]) -> Any:
    data = bpy.data.volumes.new("volume")
    data.filepath = view["cache"]
    data.render.precision = "FULL"
    data.render.clipping = 0.0
    material = bpy.data.materials.new("medium")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    density = tree.nodes.new("ShaderNodeAttribute")
    density.attribute_name = view["grid"]
    scaled = tree.nodes.new("ShaderNodeMath")
    scaled.operation = "MULTIPLY"
    scaled.inputs[1].default_value = view["extinction"]
    tree.links.new(density.outputs["Fac"], scaled.inputs[0])
    # A scattering colour is sigma_s alone; what it lacks to sigma_t is absorption.
    scatter = tree.nodes.new("ShaderNodeVolumeScatter")
    scatter.inputs["Color"].default_value = (*view["albedo"], 1.0)
    scatter.inputs["Anisotropy"].default_value = view["anisotropy"]
    tree.links.new(scaled.outputs[0], scatter.inputs["Density"])
    medium = scatter.outputs[0]
    if min(view["albedo"]) < 1.0:
        absorb = tree.nodes.new("ShaderNodeVolumeAbsorption")
        absorb.inputs["Color"].default_value = (*view["albedo"], 1.0)
        tree.links.new(scaled.outputs[0], absorb.inputs["Density"])
        both = tree.nodes.new("ShaderNodeAddShader")
        tree.links.new(medium, both.inputs[0])
        tree.links.new(absorb.outputs[0], both.inputs[1])
        medium = both.outputs[0]
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(medium, output.inputs["Volume"])
    data.materials.append(material)
    return bpy.data.objects.new("volume", data)


if __name__ == "__main__":
    serve(Cycles)
