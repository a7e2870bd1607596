// Leaves of 8^3 voxels, as OpenVDB's trees have them, and the blocks of 4^3 that are evaluated
// together in them: where they lie, and in which order their voxels come.
#pragma once

#include "noise.h"

#include <openvdb/openvdb.h>

#include <array>
#include <cmath>
#include <cstddef>

namespace pileus::make {

constexpr int kLeafSide = 8;
constexpr int kLeafVoxels = kLeafSide * kLeafSide * kLeafSide;
constexpr int kBlockSide = 4;
static_assert(kBlockSide * kBlockSide * kBlockSide == noise::kBatch);

// The values of one leaf, in the order of OpenVDB's: z fastest. A voxel is active where its
// density is above zero.
struct LeafValues {
    std::array<float, kLeafVoxels> density;
    std::array<openvdb::Vec3s, kLeafVoxels> velocity;
};

// World position of a voxel.
inline openvdb::Vec3s place(const openvdb::Coord& ijk, float voxel) {
    return openvdb::Vec3s(static_cast<float>(ijk.x()), static_cast<float>(ijk.y()),
                          static_cast<float>(ijk.z())) *
           voxel;
}

// Index coordinate of the first voxel of the leaf that a world coordinate lies in.
inline int leaf_at(float x, float voxel) {
    return static_cast<int>(std::floor(x / (voxel * kLeafSide))) * kLeafSide;
}

// Index coordinates of the n-th voxel of the leaf at `origin`.
inline openvdb::Coord voxel_of_leaf(const openvdb::Coord& origin, int n) {
    return origin.offsetBy(n >> 6, (n >> 3) & 7, n & 7);
}

// Number in its leaf of the voxel so far from the leaf's origin.
inline std::size_t number_in_leaf(int x, int y, int z) {
    return static_cast<std::size_t>((x << 6) | (y << 3) | z);
}

// Runs `block(corner)` for the eight blocks of the leaf at `origin`.
template <typename Block>
void for_each_block(const openvdb::Coord& origin, const Block& block) {
    for (int n = 0; n < 8; ++n) {
        block(origin.offsetBy((n >> 2) * kBlockSide, ((n >> 1) & 1) * kBlockSide,
                              (n & 1) * kBlockSide));
    }
}

// Index coordinates of the n-th voxel of the block at `corner`.
inline openvdb::Coord voxel_of_block(const openvdb::Coord& corner, std::size_t n) {
    const auto i = static_cast<int>(n);
    return corner.offsetBy(i >> 4, (i >> 2) & 3, i & 3);
}

}  // namespace pileus::make
