// Density caches in Python: volumes that are read, grids and procedural caches that are written.
#include "bindings.h"
#include "make/cloud.h"
#include "make/whitewater.h"
#include "vdb_file.h"
#include "volume.h"

namespace pileus::python {

namespace {

using Array3 = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

}  // namespace

void bind_volume(nb::module_& m) {
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
}

void bind_writers_of_caches(nb::module_& m) {
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

}  // namespace pileus::python
