#include "volume.h"

#include "brick_tree_builder.h"
#include "error.h"
#include "printable.h"
#include "vdb_reader.h"

#include <openvdb/tools/LevelSetUtil.h>

#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>

namespace pileus {

namespace {

openvdb::GridBase::Ptr read_grid(const std::string& path, const std::string& name) {
    VdbReader file(path);
    const auto base = file.read(name, [&](const openvdb::GridBase& grid) {
        if (grid.isType<openvdb::FloatGrid>() || grid.isType<openvdb::DoubleGrid>()) return;
        throw InputError("grid \"" + name + "\" is of type " + grid.type() +
                         ", and a density must be float or double; the file holds " +
                         file.listing());
    });
    if (!base) throw InputError("has no grid \"" + name + "\"; it holds " + file.listing());
    if (!base->transform().isLinear()) {
        throw InputError("grid \"" + name +
                         "\" has a frustum transform; resample it into a linear one");
    }
    return base;
}

Imath::M44d to_imath(const openvdb::math::Mat4d& m) {
    Imath::M44d result;
    for (int row = 0; row < 4; ++row) {
        for (int column = 0; column < 4; ++column) result[row][column] = m(row, column);
    }
    return result;
}

}  // namespace

Volume::Volume(const std::string& path, const std::string& grid) : path_(path), grid_(grid) {
    openvdb::initialize();  // does nothing the second time, and guards itself

    const auto start = std::chrono::steady_clock::now();
    try {
        if (!std::filesystem::is_regular_file(path)) throw InputError("no such file");
        const auto base = read_grid(path, grid);
        if (const auto floats = openvdb::gridPtrCast<openvdb::FloatGrid>(base)) {
            take(*floats);
        } else {
            take(*openvdb::gridPtrCast<openvdb::DoubleGrid>(base));
        }
    } catch (const InputError& error) {
        throw InputError(path + ": " + printable(error.what()));
    } catch (const std::ios_base::failure&) {
        throw InputError(path + ": cannot be read as OpenVDB (it is damaged, or ends amid its " +
                         "grids); write the cache again");
    } catch (const TooWide& error) {
        throw InputError(path + ": grid \"" + grid + "\" " + error.what());
    } catch (const std::exception& error) {  // OpenVDB's own, and the library's below it
        throw InputError(path + ": cannot be read as OpenVDB (" + printable(error.what()) +
                         "); write the cache again");
    }
    load_seconds_ = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

template <class Grid>
void Volume::take(Grid& grid) {
    active_voxels_ = static_cast<std::int64_t>(grid.activeVoxelCount());
    if (grid.getGridClass() == openvdb::GRID_LEVEL_SET) {
        openvdb::tools::sdfToFogVolume(grid);
        warnings_.push_back(path_ + ": grid \"" + grid_ +
                            "\" is a level set; its inside was made fog");
    }
    if (const auto background = grid.background(); background != 0) {
        warnings_.push_back(path_ + ": grid \"" + grid_ + "\" has a background of " +
                            std::to_string(background) + "; taken as 0");
    }
    BuiltTree built = build_brick_tree(grid.tree());
    tree_ = std::move(built.tree);

    const auto warn = [&](std::int64_t times, const char* what) {
        if (times == 0) return;
        warnings_.push_back(path_ + ": grid \"" + grid_ + "\" has " + std::to_string(times) + " " +
                            what + " voxels; taken as 0");
    };
    warn(built.census.nan, "NaN");
    warn(built.census.infinite, "infinite");
    warn(built.census.negative, "negative");
    if (tree_.empty())
        warnings_.push_back(path_ + ": grid \"" + grid_ +
                            "\" is empty; only the background is seen");

    const V3d origin(built.origin.x, built.origin.y, built.origin.z);
    const Imath::M44d index_to_world =
        to_imath(grid.transform().baseMap()->getAffineMap()->getMat4());
    local_to_world_ = Imath::M44d().setTranslation(origin) * index_to_world;
    const double determinant = local_to_world_.determinant();
    if (!std::isfinite(determinant) || determinant == 0.0) {
        throw InputError("grid \"" + grid_ +
                         "\" has a transform without inverse; give it voxels with a volume");
    }
    constexpr double least = 1e-12, most = 1e12;  // what rays in float can step through
    for (int axis = 0; axis < 3; ++axis) {
        const double side =
            V3d(local_to_world_[axis][0], local_to_world_[axis][1], local_to_world_[axis][2])
                .length();
        if (side >= least && side <= most) continue;
        char text[32];
        std::snprintf(text, sizeof text, "%.3g", side);
        throw InputError("grid \"" + grid_ + "\" has voxels " + text +
                         " world units wide; scale it to between 1e-12 and 1e12");
    }
    world_to_local_ = local_to_world_.inverse();
}

std::optional<std::pair<V3d, V3d>> Volume::world_bounds() const {
    if (empty()) return std::nullopt;
    const V3i& low = tree_.low();
    const V3i& high = tree_.high();
    constexpr double infinity = std::numeric_limits<double>::infinity();
    V3d world_low(infinity), world_high(-infinity);
    for (int corner = 0; corner < 8; ++corner) {
        const V3d local(corner & 1 ? high.x : low.x, corner & 2 ? high.y : low.y,
                        corner & 4 ? high.z : low.z);
        const V3d world = local * local_to_world_;
        for (int axis = 0; axis < 3; ++axis) {
            world_low[axis] = std::min(world_low[axis], world[axis]);
            world_high[axis] = std::max(world_high[axis], world[axis]);
        }
    }
    return std::pair{world_low, world_high};
}

}  // namespace pileus
