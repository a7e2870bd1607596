// Builds a BrickTree from an OpenVDB tree: in parallel over the leaves, with every value that a
// density cannot have set to zero and counted.
#pragma once

#include "brick_tree.h"

#include <openvdb/openvdb.h>

#include <cstdint>
#include <stdexcept>

namespace pileus {

/// What the builder met on its way.
struct Census {
    std::int64_t nan = 0, infinite = 0, negative = 0;  // active voxels and tiles; now zero
    Census& operator+=(const Census& other) {
        nan += other.nan;
        infinite += other.infinite;
        negative += other.negative;
        return *this;
    }
};

struct BuiltTree {
    BrickTree tree;
    V3i origin{0};  // index coordinates of the tree's local (0, 0, 0)
    Census census;
};

/// The widest tree that float coordinates still resolve to a sixteenth of a voxel.
constexpr std::int64_t widest_extent = std::int64_t{1} << 20;

/// Thrown where a grid spans more than `widest_extent` voxels.
struct TooWide : std::runtime_error {
    using std::runtime_error::runtime_error;
};

BuiltTree build_brick_tree(const openvdb::FloatTree& tree);
BuiltTree build_brick_tree(const openvdb::DoubleTree& tree);

}  // namespace pileus
