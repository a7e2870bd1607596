#include "vdb_file.h"

#include "error.h"
#include "whole_file.h"

#include <openvdb/io/Archive.h>
#include <openvdb/tools/Dense.h>

#include <cerrno>
#include <cmath>
#include <cstring>
#include <fstream>

namespace pileus {

namespace {

/// OpenVDB's own file writer does not notice that a disk is full.
class VdbWriter : public openvdb::io::Archive {
  public:
    void write_to(std::ostream& stream, const openvdb::GridCPtrVec& grids,
                  const openvdb::MetaMap& metadata) const {
        write(stream, grids, /*seekable=*/true, metadata);
    }
};

}  // namespace

void write_vdb(const std::string& path, const openvdb::GridCPtrVec& grids,
               const openvdb::MetaMap& metadata) {
    const auto refuse = [&](const char* reason) {
        return std::runtime_error(path + ": cannot be written (" + reason + ")");
    };
    try {
        WholeFile file(path);
        std::ofstream stream(file.location(), std::ios::binary);
        stream.exceptions(std::ios::failbit | std::ios::badbit);
        VdbWriter().write_to(stream, grids, metadata);
        stream.close();
        file.keep();
    } catch (const std::ios::failure&) {
        throw refuse(std::strerror(errno));
    } catch (const std::exception& error) {
        throw refuse(error.what());
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
