#include "vdb_file.h"

#include "error.h"

#include <openvdb/io/File.h>
#include <openvdb/tools/Dense.h>

#include <cmath>
#include <filesystem>
#include <system_error>
#include <unistd.h>

namespace pileus {

namespace fs = std::filesystem;

void write_vdb(const std::string& path, const openvdb::GridCPtrVec& grids,
               const openvdb::MetaMap& metadata) {
    const std::string temporary = path + "." + std::to_string(::getpid()) + ".tmp";
    std::error_code ignored;
    try {
        openvdb::io::File file(temporary);
        file.write(grids, metadata);
        file.close();
        fs::rename(temporary, path);
    } catch (const fs::filesystem_error& error) {
        fs::remove(temporary, ignored);
        throw std::runtime_error(path + ": cannot be written: " + error.code().message());
    } catch (const std::exception&) {
        fs::remove(temporary, ignored);
        const fs::path folder = fs::path(path).parent_path();
        const bool missing = !folder.empty() && !fs::is_directory(folder, ignored);
        throw std::runtime_error(path + ": cannot be written: " +
                                 (missing ? "no such folder" : "the folder refuses it or is full"));
    }
}

void write_grid(const std::string& path, const std::string& name, const std::vector<Block>& blocks,
                const V3d& voxel, const V3d& origin) {
    for (int axis = 0; axis < 3; ++axis) {
        if (!(voxel[axis] > 0.0) || !std::isfinite(voxel[axis]) || !std::isfinite(origin[axis]))
            throw InputError("a grid's voxels need positive sizes and a finite origin");
    }
    openvdb::initialize();
    const auto grid = openvdb::FloatGrid::create(0.0f);
    grid->setName(name);
    grid->setGridClass(openvdb::GRID_FOG_VOLUME);
    openvdb::math::Mat4d to_world = openvdb::math::Mat4d::identity();
    to_world.preScale(openvdb::Vec3d(voxel.x, voxel.y, voxel.z));
    to_world.setTranslation(openvdb::Vec3d(origin.x, origin.y, origin.z));
    grid->setTransform(openvdb::math::Transform::createLinearTransform(to_world));
    for (const Block& block : blocks) {
        const openvdb::Coord low(block.origin.x, block.origin.y, block.origin.z);
        const openvdb::Coord high =
            low.offsetBy(block.shape.x - 1, block.shape.y - 1, block.shape.z - 1);
        using Array = openvdb::tools::Dense<const float, openvdb::tools::LayoutZYX>;
        const Array array(openvdb::CoordBBox(low, high), block.values);
        openvdb::tools::copyFromDense(array, *grid, 0.0f);
        // NaN, which differs from the background by no tolerance, was left out.
        auto accessor = grid->getAccessor();
        for (auto at = array.bbox().begin(); at; ++at) {
            if (std::isnan(array.getValue(*at))) accessor.setValueOn(*at, array.getValue(*at));
        }
    }
    write_vdb(path, {grid});
}

}  // namespace pileus
