// Fills sparse grids leaf by leaf in parallel and writes them as one cache. Each leaf is computed
// from its place alone, so the result depends neither on threads nor on order.
#pragma once

#include "leaf.h"
#include "options.h"

#include <openvdb/openvdb.h>
#include <tbb/parallel_for.h>

#include <cstddef>
#include <memory>
#include <string>
#include <vector>

namespace pileus::make {

// Density below this is dropped: it is under what half floats and the eye can tell.
constexpr float kFaint = 1e-3F;

class Cache {
  public:
    explicit Cache(double voxel_size);

    // Runs `fill(origin, values)` for each leaf origin; a leaf whose fill returns false is empty.
    template <typename Fill>
    void fill_leaves(const std::vector<openvdb::Coord>& origins, const Fill& fill) {
        std::vector<Leaf> leaves(origins.size());
        tbb::parallel_for(std::size_t{0}, origins.size(), [&](std::size_t i) {
            thread_local LeafValues values;
            if (fill(origins[i], values)) leaves[i] = pack(origins[i], values);
        });
        insert(leaves);
    }

    // Writes whole or not at all. Returns the number of active voxels. Throws std::runtime_error
    // naming the path.
    std::int64_t write(const std::string& path, const MakeOptions& options,
                       const std::string& creator);

  private:
    using DensityLeaf = openvdb::FloatTree::LeafNodeType;
    using VelocityLeaf = openvdb::Vec3STree::LeafNodeType;
    struct Leaf {
        std::unique_ptr<DensityLeaf> density;
        std::unique_ptr<VelocityLeaf> velocity;
    };

    static Leaf pack(const openvdb::Coord& origin, const LeafValues& values);
    void insert(std::vector<Leaf>& leaves);

    openvdb::FloatGrid::Ptr density_;
    openvdb::Vec3SGrid::Ptr velocity_;
};

// Makes one frame of a `Shape`, which tells its voxel size, the leaves that it may reach and what
// fills each. Returns the number of active voxels.
template <typename Shape>
std::int64_t make_cache(const std::string& path, const MakeOptions& options,
                        const std::string& creator) {
    validate(options);
    openvdb::initialize();
    const Shape shape(options);
    Cache cache(shape.voxel());
    cache.fill_leaves(shape.leaves(), [&](const openvdb::Coord& origin, LeafValues& values) {
        return shape.fill(origin, values);
    });
    return cache.write(path, options, creator);
}

}  // namespace pileus::make
