// What the parts of the Python module share. Everything that takes long releases the interpreter's
// lock.
#pragma once

#include "scene.h"

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

#include <array>
#include <tuple>

namespace pileus::python {

namespace nb = nanobind;
using namespace nb::literals;

using Triple = std::array<double, 3>;
using BucketTuple = std::tuple<int, int, int, int>;
using RangeTuple = std::tuple<int, int>;

inline V3d to_v3d(const Triple& t) { return {t[0], t[1], t[2]}; }
inline V3f to_v3f(const Triple& t) { return V3f(to_v3d(t)); }
inline Triple to_triple(const V3d& v) { return {v.x, v.y, v.z}; }
inline Bucket to_bucket(const BucketTuple& t) {
    return {std::get<0>(t), std::get<1>(t), std::get<2>(t), std::get<3>(t)};
}

// The parts, in the order in which later ones name earlier ones.
void bind_volume(nb::module_& m);
void bind_camera_and_lights(nb::module_& m);
void bind_look(nb::module_& m);
void bind_scene(nb::module_& m);
void bind_transport(nb::module_& m);
void bind_partial_and_frame(nb::module_& m);
void bind_render(nb::module_& m);
void bind_read_image(nb::module_& m);
void bind_writers_of_caches(nb::module_& m);

}  // namespace pileus::python
