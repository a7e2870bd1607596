// The Python module pileus_core. Everything that takes long releases the interpreter's lock.
#include "error.h"
#include "frame.h"
#include "make/cloud.h"
#include "make/whitewater.h"
#include "render.h"
#include "vdb_file.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/map.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/variant.h>
#include <nanobind/stl/vector.h>

#include <memory>
#include <tuple>

namespace nb = nanobind;
using namespace nb::literals;

namespace pileus {

namespace {

using Triple = std::array<double, 3>;
using BucketTuple = std::tuple<int, int, int, int>;
using RangeTuple = std::tuple<int, int>;
using Pixels = nb::ndarray<nb::numpy, float>;
using Array3 = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using PythonHeader =
    std::map<std::string,
             std::variant<std::string, double, std::pair<int, int>, std::vector<double>>>;

V3d to_v3d(const Triple& t) { return {t[0], t[1], t[2]}; }
V3f to_v3f(const Triple& t) { return V3f(to_v3d(t)); }

/// Light that is there: a negative or infinite one would spoil pixels.
Color to_light(const char* field, const Triple& t) {
    for (const double value : t) {
        if (!(value >= 0.0 && value <= 1e12))
            throw InputError(std::string("lights.") + field + " must lie between 0 and 1e12");
    }
    return to_v3f(t);
}
Triple to_triple(const V3d& v) { return {v.x, v.y, v.z}; }
Bucket to_bucket(const BucketTuple& t) {
    return {std::get<0>(t), std::get<1>(t), std::get<2>(t), std::get<3>(t)};
}
BucketTuple to_tuple(const Bucket& b) { return {b.x0, b.y0, b.x1, b.y1}; }

std::vector<double> flatten(const Imath::M44d& m) { return {m.getValue(), m.getValue() + 16}; }

/// A light and what was odd about its making.
struct NamedLight {
    std::shared_ptr<const Light> light;
    std::vector<std::string> warnings;
};
struct DistantLightHandle : NamedLight {};
struct DomeLightHandle : NamedLight {};

struct PixelOwner {
    std::vector<float> values;
};

/// A NumPy array that owns a copy of the values.
Pixels to_array(std::vector<float> values, std::initializer_list<std::size_t> shape) {
    auto owner = std::make_unique<PixelOwner>(PixelOwner{std::move(values)});
    float* const data = owner->values.data();
    nb::capsule capsule(owner.release(), [](void* p) noexcept {
        std::unique_ptr<PixelOwner>(static_cast<PixelOwner*>(p));
    });
    return Pixels(data, shape, capsule);
}

std::map<std::string, Pixels> channels_of(const LayeredImage& image, std::size_t look) {
    std::map<std::string, Pixels> result;
    const auto height = static_cast<std::size_t>(image.window().height());
    const auto width = static_cast<std::size_t>(image.window().width());
    for (std::size_t c = 0; c < image.channels().size(); ++c) {
        const float* const plane = image.plane(look, c);
        result.emplace(image.channels()[c],
                       to_array({plane, plane + image.window().pixels()}, {height, width}));
    }
    return result;
}

Pixels rgba_of(const LayeredImage& image, std::size_t look) {
    const std::size_t pixels = image.window().pixels();
    std::vector<float> values(pixels * 4);
    for (std::size_t c = 0; c < 4; ++c) {
        const float* const plane = image.plane(look, c);
        for (std::size_t i = 0; i < pixels; ++i) values[4 * i + c] = plane[i];
    }
    return to_array(std::move(values), {static_cast<std::size_t>(image.window().height()),
                                        static_cast<std::size_t>(image.window().width()), 4});
}

Header to_header(const PythonHeader& values) {
    Header header;
    for (const auto& [name, value] : values) {
        if (const auto* text = std::get_if<std::string>(&value)) {
            header[name] = *text;
        } else if (const auto* number = std::get_if<double>(&value)) {
            header[name] = static_cast<float>(*number);
        } else if (const auto* ratio = std::get_if<std::pair<int, int>>(&value)) {
            header[name] =
                std::pair<int, unsigned>(ratio->first, static_cast<unsigned>(ratio->second));
        } else {
            const auto& list = std::get<std::vector<double>>(value);
            if (list.size() != 16) throw InputError("header " + name + ": a matrix has 16 values");
            Imath::M44f matrix;
            for (std::size_t i = 0; i < 16; ++i) matrix.getValue()[i] = static_cast<float>(list[i]);
            header[name] = matrix;
        }
    }
    return header;
}

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

/// Raises wrong input in Python. What a file put into the message and Python would not print, as a
/// mark that turns the line around, is shown escaped.
void raise_input_error(const std::exception_ptr& thrown, void* type) {
    try {
        std::rethrow_exception(thrown);
    } catch (const InputError& error) {
        const std::string_view what = error.what();
        const auto length = static_cast<Py_ssize_t>(what.size());
        const auto text = nb::steal(PyUnicode_DecodeUTF8(what.data(), length, "backslashreplace"));
        nb::list shown;
        for (const nb::handle letter : text) {
            const bool prints = nb::cast<bool>(letter.attr("isprintable")());
            shown.append(prints ? nb::borrow(letter)
                                : letter.attr("encode")("unicode_escape").attr("decode")());
        }
        PyErr_SetObject(static_cast<PyObject*>(type), nb::str("").attr("join")(shown).ptr());
    }
}

}  // namespace

NB_MODULE(_core, m) {
    m.doc() = "The Pileus renderer.";
    m.attr("__version__") = PILEUS_VERSION;
    m.attr("METHODS") = method_names();

    const nb::exception<InputError> input_error(m, "InputError", PyExc_ValueError);
    nb::register_exception_translator(raise_input_error, input_error.ptr());
    nb::exception<Cancelled>(m, "Cancelled", PyExc_Exception);

    nb::class_<Volume>(m, "Volume", "A density field read from an OpenVDB file; immutable.")
        .def(nb::init<const std::string&, const std::string&>(), "path"_a, "grid"_a = "density",
             nb::call_guard<nb::gil_scoped_release>(),
             "Reads one scalar grid: by name, \"\" for an unnamed one, \"name[n]\" for the n-th of "
             "several. Raises "
             "InputError.")
        .def_prop_ro("path", &Volume::path)
        .def_prop_ro("grid", &Volume::grid)
        .def_prop_ro("bytes", &Volume::bytes, "Memory held, in bytes.")
        .def_prop_ro("active_voxels", &Volume::active_voxels)
        .def_prop_ro("empty", &Volume::empty)
        .def_prop_ro("load_seconds", &Volume::load_seconds)
        .def_prop_ro("warnings", &Volume::warnings,
                     "What was odd but could be decided, a line each.")
        .def(
            "interpolate",
            [](const Volume& volume, const Triple& world) {
                const V3f local(to_v3d(world) * volume.world_to_local());
                return volume.empty() ? 0.0f : volume.tree().interpolate(local);
            },
            "position"_a,
            "The density at a world position near the volume, interpolated trilinearly.")
        .def_prop_ro(
            "world_bounds",
            [](const Volume& volume) -> std::optional<std::pair<Triple, Triple>> {
                const auto bounds = volume.world_bounds();
                if (!bounds) return std::nullopt;
                return std::pair{to_triple(bounds->first), to_triple(bounds->second)};
            },
            "The world box around everything stored; None for an empty grid.");

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
                auto light = make_dome_light(to_light("radiance", radiance), texture, warnings);
                new (self) DomeLightHandle{{std::move(light), std::move(warnings)}};
            },
            nb::kw_only(), "radiance"_a, "texture"_a = "",
            "Constant radiance, times a lat-long texture where one is named (+y up, +z its "
            "middle). Raises InputError.");

    nb::class_<Look>(m, "Look", "The artist's a, b and c, each in [0, 1].")
        .def(
            "__init__",
            [](Look* self, const std::string& name, double a, double b, double c) {
                new (self)
                    Look{name, static_cast<float>(a), static_cast<float>(b), static_cast<float>(c)};
            },
            nb::kw_only(), "name"_a, "a"_a = 1.0, "b"_a = 1.0, "c"_a = 1.0);

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

    nb::class_<Transport>(m, "Transport", "A method with its bounces and looks.")
        .def(
            "__init__",
            [](Transport* self, const std::string& method, std::optional<int> max_bounces,
               const std::vector<Look>& looks, int reduce_from) {
                new (self) Transport(resolve({method, max_bounces, looks, reduce_from}));
            },
            nb::kw_only(), "method"_a, "max_bounces"_a = nb::none(), "looks"_a, "reduce_from"_a = 3,
            "Without `max_bounces`, the method's own number; None stays None for `reference` and "
            "`similarity`: unlimited. `reduce_from` is the first event that `similarity` reaches "
            "through a reduced medium. Raises InputError.")
        .def_ro("method", &Transport::method)
        .def_ro("max_bounces", &Transport::max_bounces)
        .def_ro("reduce_from", &Transport::reduce_from);

    nb::class_<Control>(m, "Control", "What another thread sees of a render, and how it ends it.")
        .def(nb::init<>())
        .def_prop_ro(
            "samples_done", [](const Control& c) { return c.samples_done.load(); },
            "Pixel samples finished.")
        .def(
            "cancel", [](Control& c) { c.cancelled = true; }, "The render raises Cancelled soon.");

    nb::class_<Partial>(m, "Partial", "The pixels of one bucket over one range of samples.")
        .def_prop_ro("bucket", [](const Partial& p) { return to_tuple(p.image.window()); })
        .def_prop_ro("samples",
                     [](const Partial& p) { return RangeTuple(p.samples.first, p.samples.last); })
        .def_prop_ro("looks", [](const Partial& p) { return p.image.looks(); })
        .def_ro("identity", &Partial::identity)
        .def_ro("bounded_paths", &Partial::bounded_paths, "Paths that the bound on work has ended.")
        .def(
            "relative_error", &Partial::relative_error,
            "The RMS relative error of its pixels for their noise, one standard error more than it "
            "seems to be.")
        .def_prop_ro("opacity", &Partial::opacity, "The mean of 1 - transmittance.")
        .def(
            "channels",
            [](const Partial& p, const std::string& look) {
                return channels_of(p.image, p.image.look_index(look));
            },
            "look"_a, "Float arrays of shape (height, width) by channel.")
        .def(
            "write",
            [](Partial& p, const std::string& path, const std::string& identity) {
                p.identity = identity;
                const nb::gil_scoped_release release;
                p.write(path);
            },
            "path"_a, "identity"_a, "Whole or not at all. Raises RuntimeError.")
        .def_static("read", &Partial::read, "path"_a, nb::call_guard<nb::gil_scoped_release>(),
                    "Raises InputError for a file that is truncated, altered or no partial.");

    nb::class_<Frame>(m, "Frame", "The merge of partials into one image.")
        .def(
            "__init__",
            [](Frame* self, int width, int height,
               const std::vector<std::pair<BucketTuple, std::optional<int>>>& plan) {
                std::vector<std::pair<Bucket, std::optional<int>>> buckets;
                for (const auto& [bucket, samples] : plan)
                    buckets.emplace_back(to_bucket(bucket), samples);
                new (self) Frame(width, height, std::move(buckets));
            },
            "width"_a, "height"_a, "plan"_a,
            "The plan: each bucket with the samples it must reach; None: as many as its one "
            "partial has. Raises InputError.")
        .def("add", &Frame::add, "partial"_a, nb::call_guard<nb::gil_scoped_release>(),
             "Takes a bucket's next samples. Raises InputError for any that overlap, leave a gap "
             "or do not belong.")
        .def(
            "write",
            [](const Frame& frame, const std::string& path, bool half, const PythonHeader& values) {
                const Header header = to_header(values);
                const nb::gil_scoped_release release;
                frame.write(path, half, header);
            },
            "path"_a, nb::kw_only(), "half"_a = false, "header"_a = PythonHeader{},
            "Whole or not at all. Raises InputError where samples are missing, RuntimeError where "
            "it cannot be written.")
        .def_prop_ro("mean_samples", &Frame::mean_samples,
                     "Samples a pixel, over those that have all of theirs.")
        .def("relative_error", &Frame::relative_error,
             "The RMS relative error of the pixels, from their variances.")
        .def_prop_ro("bounded_paths", &Frame::bounded_paths,
                     "Paths that the bound on work has ended, of all partials.")
        .def(
            "set_denoised",
            [](Frame& frame,
               const std::vector<nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig,
                                             nb::device::cpu>>& colors) {
                std::vector<std::vector<float>> values;
                for (const auto& rgb : colors)
                    values.emplace_back(rgb.data(), rgb.data() + rgb.size());
                frame.set_denoised(values);
            },
            "colors"_a,
            "Puts denoised RGB of shape (height, width, 3), one array a look, in the place of the "
            "rendered, which is kept as noisy.R, noisy.G and noisy.B. Raises InputError.")
        .def(
            "pixels",
            [](const Frame& frame, const std::string& look) {
                return rgba_of(frame.image(), frame.image().look_index(look));
            },
            "look"_a, "RGBA of shape (height, width, 4).");

    m.def(
        "render",
        [](const Scene& scene, const Transport& transport, const BucketTuple& bucket,
           const RangeTuple& samples, std::uint64_t seed, int frame, bool orders, int threads,
           Control* control) {
            Control own;
            const RenderTask task{to_bucket(bucket),
                                  {std::get<0>(samples), std::get<1>(samples)},
                                  seed,
                                  frame,
                                  orders};
            const nb::gil_scoped_release release;
            return render(scene, transport, task, threads, control ? *control : own);
        },
        "scene"_a, "transport"_a, nb::kw_only(), "bucket"_a, "samples"_a, "seed"_a, "frame"_a,
        "orders"_a = false, "threads"_a = 0, "control"_a.none() = nb::none(),
        "Renders a bucket (x0, y0, x1, y1) over the samples [first, last). Raises InputError, "
        "Cancelled.");

    m.def(
        "render_until",
        [](const Scene& scene, const Transport& transport, const BucketTuple& bucket, int samples,
           double tolerance, double opacity, std::uint64_t seed, int frame, bool orders,
           int threads, Control* control) {
            Control own;
            const RenderTask task{to_bucket(bucket), {0, samples}, seed, frame, orders};
            const nb::gil_scoped_release release;
            return render_until(scene, transport, task, tolerance, opacity, threads,
                                control ? *control : own);
        },
        "scene"_a, "transport"_a, nb::kw_only(), "bucket"_a, "samples"_a, "tolerance"_a,
        "opacity"_a, "seed"_a, "frame"_a, "orders"_a = false, "threads"_a = 0,
        "control"_a.none() = nb::none(),
        "Renders a bucket until it does its share for a frame of the mean opacity `opacity` that "
        "may have the RMS relative error `tolerance`, with at most `samples` a pixel. Raises "
        "InputError, Cancelled.");

    m.def(
        "read_image",
        [](const std::string& path) {
            const ExrFile file = read_exr(path);
            std::map<std::string, std::map<std::string, Pixels>> result;
            for (std::size_t look = 0; look < file.image.looks().size(); ++look) {
                result.emplace(file.image.looks()[look], channels_of(file.image, look));
            }
            return result;
        },
        "path"_a,
        "An EXR's float arrays of shape (height, width), by part and channel. Raises InputError.");

    m.def(
        "write_grid",
        [](const std::string& path, const std::vector<std::pair<std::array<int, 3>, Array3>>& parts,
           const Triple& voxel, const Triple& origin, const std::string& name) {
            std::vector<Block> blocks;
            for (const auto& [low, array] : parts) {
                const auto side = [&](std::size_t axis) {
                    return static_cast<int>(array.shape(axis));
                };
                blocks.push_back(
                    {V3i(low[0], low[1], low[2]), V3i(side(0), side(1), side(2)), array.data()});
            }
            const nb::gil_scoped_release release;
            write_grid(path, name, blocks, to_v3d(voxel), to_v3d(origin));
        },
        "path"_a, "blocks"_a, nb::kw_only(), "voxel"_a = Triple{1.0, 1.0, 1.0},
        "origin"_a = Triple{0.0, 0.0, 0.0}, "name"_a = "density",
        "Writes float32 arrays, each with the index of its first value, as one grid; index (i, j, "
        "k) lies at origin + (i, j, k) * voxel. Raises InputError, RuntimeError.");

    const auto bind_make = [&m](const char* name, auto make, const char* doc) {
        m.def(
            name,
            [make](const std::string& path, int frame, int frames, int resolution,
                   std::uint64_t seed) {
                const nb::gil_scoped_release release;
                return make(path, MakeOptions{frame, frames, resolution, seed});
            },
            "path"_a, nb::kw_only(), "frame"_a, "frames"_a, "resolution"_a, "seed"_a = 0, doc);
    };
    bind_make("make_cloud", &make_cloud,
              "Writes one frame of a drifting, billowing cumulus; returns its active voxels.");
    bind_make("make_whitewater", &make_whitewater,
              "Writes one frame of a breaking splash; returns its active voxels.");
}

}  // namespace pileus
