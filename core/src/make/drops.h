// Water in flight, sorted by the leaves that it reaches into and splatted into their voxels.
#pragma once

#include "leaf.h"

#include <openvdb/openvdb.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace pileus::make {

// Drawn out along its path. A drop has a hard edge; spray is a soft streak of drops too small to
// tell apart; mist hangs in the air, and air tears it.
enum class Kind { kDrop, kSpray, kMist };
struct Drop {
    openvdb::Vec3s head;
    openvdb::Vec3s tail;
    float radius;
    float amount;
    openvdb::Vec3s velocity;
    Kind kind;
};

class Drops {
  public:
    Drops(std::vector<Drop> drops, float voxel);

    // Origins of the leaves that any drop reaches into, in order.
    std::vector<openvdb::Coord> leaves() const;

    // Calls `put(drop, voxel, density)` for each drop and each voxel of the leaf that it covers, in
    // the order of the drops; voxels are numbers in the leaf.
    template <typename Put>
    void splat(const openvdb::Coord& origin, const Put& put) const {
        const auto [first, last] =
            std::equal_range(shares_.begin(), shares_.end(), Share{origin, 0},
                             [](const Share& a, const Share& b) { return a.leaf < b.leaf; });
        for (auto share = first; share != last; ++share) {
            const Drop& drop = drops_[share->drop];
            const Range range = covered(origin, drop);
            for (int x = range.low[0]; x <= range.high[0]; ++x) {
                for (int y = range.low[1]; y <= range.high[1]; ++y) {
                    for (int z = range.low[2]; z <= range.high[2]; ++z) {
                        const float density = density_at(drop, origin, x, y, z);
                        if (density > 0.0F) put(drop, number_in_leaf(x, y, z), density);
                    }
                }
            }
        }
    }

  private:
    // A share of a leaf in a drop.
    struct Share {
        openvdb::Coord leaf;
        std::uint32_t drop;
    };
    // Voxels of a leaf, both ends included.
    struct Range {
        openvdb::Coord low;
        openvdb::Coord high;
    };

    float reach(const Drop& drop) const;
    Range covered(const openvdb::Coord& origin, const Drop& drop) const;
    float density_at(const Drop& drop, const openvdb::Coord& origin, int x, int y, int z) const;

    float voxel_;
    std::vector<Drop> drops_;
    std::vector<Share> shares_;
};

}  // namespace pileus::make
