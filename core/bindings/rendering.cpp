// Transport and the renderer in Python.
#include "bindings.h"
#include "render.h"

namespace pileus::python {

namespace {

SampleRange to_range(const RangeTuple& t) { return {std::get<0>(t), std::get<1>(t)}; }

}  // namespace

void bind_look(nb::module_& m) {
    nb::class_<Look>(m, "Look", "The artist's a, b and c, each in [0, 1].")
        .def(
            "__init__",
            [](Look* self, const std::string& name, double a, double b, double c) {
                new (self)
                    Look{name, static_cast<float>(a), static_cast<float>(b), static_cast<float>(c)};
            },
            nb::kw_only(), "name"_a, "a"_a = 1.0, "b"_a = 1.0, "c"_a = 1.0);
}

void bind_transport(nb::module_& m) {
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
}

void bind_render(nb::module_& m) {
    m.def(
        "render",
        [](const Scene& scene, const Transport& transport, const BucketTuple& bucket,
           const RangeTuple& samples, std::uint64_t seed, int frame, int orders, int threads,
           Control* control) {
            Control own;
            const RenderTask task{to_bucket(bucket), to_range(samples), seed, frame, orders};
            const nb::gil_scoped_release release;
            return render(scene, transport, task, threads, control ? *control : own);
        },
        "scene"_a, "transport"_a, nb::kw_only(), "bucket"_a, "samples"_a, "seed"_a, "frame"_a,
        "orders"_a = 0, "threads"_a = 0, "control"_a.none() = nb::none(),
        "Renders a bucket (x0, y0, x1, y1) over the samples [first, last). It keeps the images of "
        "so many orders; the last one holds all later ones, too. Raises InputError, Cancelled.");

    m.def(
        "render_parts",
        [](const Scene& scene, const Transport& transport,
           const std::vector<std::tuple<BucketTuple, RangeTuple, std::uint64_t>>& parts, int frame,
           int orders, int threads, Control* control) {
            Control own;
            std::vector<RenderTask> tasks;
            for (const auto& [bucket, samples, seed] : parts)
                tasks.push_back({to_bucket(bucket), to_range(samples), seed, frame, orders});
            const nb::gil_scoped_release release;
            return render(scene, transport, tasks, threads, control ? *control : own);
        },
        "scene"_a, "transport"_a, "parts"_a, nb::kw_only(), "frame"_a, "orders"_a = 0,
        "threads"_a = 0, "control"_a.none() = nb::none(),
        "Renders many parts, each of a bucket, samples and a seed, at once, to the bits that "
        "`render` makes of each. Raises InputError, Cancelled.");
}

}  // namespace pileus::python
