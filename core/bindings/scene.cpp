// A frame's scene in Python: camera, lights, medium.
#include "scene.h"

#include "bindings.h"
#include "error.h"

#include <memory>

namespace pileus::python {

namespace {

/// Light that is there: a negative or infinite one would spoil pixels.
Color to_light(const char* field, const Triple& t) {
    for (const double value : t) {
        if (!(value >= 0.0 && value <= 1e12))
            throw InputError(std::string("lights.") + field + " must lie between 0 and 1e12");
    }
    return to_v3f(t);
}

std::vector<double> flatten(const Imath::M44d& m) { return {m.getValue(), m.getValue() + 16}; }

/// A light and what was odd about its making.
struct NamedLight {
    std::shared_ptr<const Light> light;
    std::vector<std::string> warnings;
};
struct DistantLightHandle : NamedLight {};
struct DomeLightHandle : NamedLight {};

Scene make_scene(std::shared_ptr<const Volume> volume, double extinction, const Triple& albedo,
                 double anisotropy, const Camera& camera, const std::vector<NamedLight>& lights,
                 int width, int height, bool background) {
    if (!(extinction >= 0.0 && extinction <= 1e12))
        throw InputError("volumes.extinction must lie between 0 and 1e12");
    for (const double value : albedo) {
        if (!(value >= 0.0 && value <= 1.0))
            throw InputError("volumes.albedo must lie between 0 and 1");
    }
    if (!(std::abs(static_cast<float>(anisotropy)) < 1.0f))
        throw InputError("volumes.anisotropy must lie between -1 and 1, exclusive, as a float");
    if (width < 1 || height < 1)
        throw InputError("image.width and image.height must be at least 1");
    Medium medium(*volume, static_cast<float>(extinction), to_v3f(albedo),
                  static_cast<float>(anisotropy));
    std::vector<std::shared_ptr<const Light>> bare;
    for (const auto& light : lights) bare.push_back(light.light);
    return {std::move(volume), medium, camera, std::move(bare), width, height, background};
}

}  // namespace

void bind_camera_and_lights(nb::module_& m) {
    nb::class_<Camera>(m, "Camera", "A perspective camera.")
        .def(
            "__init__",
            [](Camera* self, const Triple& position, const Triple& look_at, const Triple& up,
               double fov) {
                new (self) Camera(to_v3d(position), to_v3d(look_at), to_v3d(up), fov);
            },
            nb::kw_only(), "position"_a, "look_at"_a, "up"_a, "fov"_a,
            "World coordinates; `fov` is horizontal, in degrees. Raises InputError.")
        .def(
            "world_to_camera", [](const Camera& c) { return flatten(c.world_to_camera()); },
            "16 values, row by row, for row vectors, as OpenEXR's standard attribute.")
        .def(
            "world_to_ndc",
            [](const Camera& c, int width, int height) {
                return flatten(c.world_to_ndc(width, height));
            },
            "width"_a, "height"_a,
            "16 values, row by row, for row vectors, as OpenEXR's standard attribute.");

    nb::class_<NamedLight>(m, "Light", "A light infinitely far away.")
        .def_ro("warnings", &NamedLight::warnings,
                "What was odd but could be decided, a line each.");
    nb::class_<DistantLightHandle, NamedLight>(m, "DistantLight",
                                               "Parallel light, or a disc in the sky.")
        .def(
            "__init__",
            [](DistantLightHandle* self, const Triple& direction, const Triple& irradiance,
               double angle) {
                const double length = to_v3d(direction).length();
                if (!(length > 0.0) || !std::isfinite(length))
                    throw InputError("lights.direction must have a length, of at most 1e150");
                if (!(angle >= 0.0 && angle < 180.0))
                    throw InputError("lights.angle must lie between 0 and 180 degrees");
                new (self)
                    DistantLightHandle{{make_distant_light(V3f(to_v3d(direction).normalized()),
                                                           to_light("irradiance", irradiance),
                                                           static_cast<float>(angle)),
                                        {}}};
            },
            nb::kw_only(), "direction"_a, "irradiance"_a, "angle"_a = 0.0,
            "`direction` is the way the light travels, `irradiance` falls on a plane facing it, "
            "`angle` is the angular "
            "diameter in degrees. Raises InputError.");
    nb::class_<DomeLightHandle, NamedLight>(m, "DomeLight", "The sky.")
        .def(
            "__init__",
            [](DomeLightHandle* self, const Triple& radiance, const std::string& texture) {
                std::vector<std::string> warnings;
                const nb::gil_scoped_release release;
                auto light = make_dome_light(to_light("radiance", radiance), texture, warnings);
                new (self) DomeLightHandle{{std::move(light), std::move(warnings)}};
            },
            nb::kw_only(), "radiance"_a, "texture"_a = "",
            "Constant radiance, times a lat-long texture where one is named (+y up, +z its "
            "middle). Raises InputError.");
}

void bind_scene(nb::module_& m) {
    nb::class_<Scene>(m, "Scene", "One frame, resolved.")
        .def(
            "__init__",
            [](Scene* self, std::shared_ptr<Volume> volume, double extinction, const Triple& albedo,
               double anisotropy, const Camera& camera, const std::vector<NamedLight>& lights,
               int width, int height, bool background) {
                new (self) Scene(make_scene(std::move(volume), extinction, albedo, anisotropy,
                                            camera, lights, width, height, background));
            },
            nb::kw_only(), "volume"_a, "extinction"_a, "albedo"_a, "anisotropy"_a, "camera"_a,
            "lights"_a, "width"_a, "height"_a, "background"_a = true, "Raises InputError.")
        .def(
            "touches",
            [](const Scene& scene, const BucketTuple& bucket) {
                return scene.touches(to_bucket(bucket));
            },
            "bucket"_a, "False where no ray of the bucket can meet the volume.");
}

}  // namespace pileus::python
