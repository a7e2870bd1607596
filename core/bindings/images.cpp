// Images in Python: partials, their merge into a frame, EXR files.
#include "bindings.h"
#include "error.h"
#include "exr_file.h"
#include "frame.h"
#include "partial.h"

#include <memory>

namespace pileus::python {

namespace {

using Pixels = nb::ndarray<nb::numpy, float>;
using PythonHeader =
    std::map<std::string,
             std::variant<std::string, double, std::pair<int, int>, std::vector<double>>>;

BucketTuple to_tuple(const Bucket& b) { return {b.x0, b.y0, b.x1, b.y1}; }

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

}  // namespace

void bind_partial_and_frame(nb::module_& m) {
    nb::class_<Partial>(m, "Partial", "The pixels of one bucket over one range of samples.")
        .def_prop_ro("bucket", [](const Partial& p) { return to_tuple(p.image.window()); })
        .def_prop_ro("samples",
                     [](const Partial& p) { return RangeTuple(p.samples.first, p.samples.last); })
        .def_prop_ro("looks", [](const Partial& p) { return p.image.looks(); })
        .def_ro("identity", &Partial::identity)
        .def_ro("bounded_paths", &Partial::bounded_paths, "Paths that the bound on work has ended.")
        .def_rw("unmet", &Partial::unmet,
                "It has had all the samples it may have, and misses its share of the tolerance.")
        .def(
            "relative_error", &Partial::relative_error, nb::call_guard<nb::gil_scoped_release>(),
            "The RMS relative error of its pixels for their noise, one standard error more than it "
            "seems to be.")
        .def(
            "orders",
            [](const Partial& p, const std::string& look) {
                const LayeredImage& image = p.image;
                const Bucket& window = image.window();
                const std::size_t planes = image.channels().size() - Partial::first_order;
                const float* const first =
                    planes > 0 ? image.plane(image.look_index(look), Partial::first_order)
                               : nullptr;
                return to_array({first, first + planes * window.pixels()},
                                {planes / 3, 3, static_cast<std::size_t>(window.height()),
                                 static_cast<std::size_t>(window.width())});
            },
            "look"_a, "Of shape (orders, 3, height, width).")
        .def(
            "pixels",
            [](const Partial& p, const std::string& look) {
                return rgba_of(p.image, p.image.look_index(look));
            },
            "look"_a, "RGBA, of shape (height, width, 4).")
        .def_prop_ro("opacity", &Partial::opacity, "The mean of 1 - transmittance.")
        .def("pool", &Partial::pool_comparing, "other"_a, nb::call_guard<nb::gil_scoped_release>(),
             "Adds other samples of the same bucket, and keeps what the two differ by for "
             "`relative_error`. Raises InputError.")
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

    m.def("smoothed_error", &smoothed_error, "half"_a, "other"_a, "margin"_a,
          nb::call_guard<nb::gil_scoped_release>(),
          "The RMS relative error of two independent halves of a bucket's samples together, once "
          "they are smoothed, and `margin` standard errors more. Infinite where there are too few "
          "pixels to know.");

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
        .def("relative_error", &Frame::relative_error, nb::call_guard<nb::gil_scoped_release>(),
             "The RMS relative error of the pixels, from their variances.")
        .def_prop_ro("bounded_paths", &Frame::bounded_paths,
                     "Paths that the bound on work has ended, of all partials.")
        .def_prop_ro("unmet_buckets", &Frame::unmet_buckets,
                     "Those that have had all the samples they may have, and miss their share of "
                     "the tolerance.")
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
}

void bind_read_image(nb::module_& m) {
    m.def(
        "read_image",
        [](const std::string& path) {
            const ExrFile file = [&] {
                const nb::gil_scoped_release release;
                return read_exr(path);
            }();
            std::map<std::string, std::map<std::string, Pixels>> result;
            for (std::size_t look = 0; look < file.image.looks().size(); ++look) {
                result.emplace(file.image.looks()[look], channels_of(file.image, look));
            }
            return result;
        },
        "path"_a,
        "An EXR's float arrays of shape (height, width), by part and channel. Raises InputError.");
}

}  // namespace pileus::python
