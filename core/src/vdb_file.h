// Writing OpenVDB files: grids whole or not at all, and arrays of values as a density grid, which
// is the way to a cache of known content.
#pragma once

#include "geometry.h"

#include <openvdb/openvdb.h>

#include <string>
#include <vector>

namespace pileus {

/// Writes whole or not at all. Throws std::runtime_error, one line that names the path.
void write_vdb(const std::string& path, const openvdb::GridCPtrVec& grids,
               const openvdb::MetaMap& metadata = {});

/// Values at the integer coordinates from `origin` on, z fastest.
struct Block {
    V3i origin, shape;
    const float* values;
};

/// Writes the blocks as one float grid; zeros are not stored, and where blocks overlap the later
/// one holds. Index (i, j, k) lies in the world at `origin` + (i, j, k) * `voxel`. Throws
/// InputError for voxels without a volume, and as `write_vdb`.
void write_grid(const std::string& path, const std::string& name, const std::vector<Block>& blocks,
                const V3d& voxel, const V3d& origin);

}  // namespace pileus
