// Which leaves a drop reaches into, and its density in their voxels.
#include "drops.h"

#include <tbb/parallel_sort.h>

#include <cmath>
#include <tuple>
#include <utility>

namespace pileus::make {

using openvdb::Coord;
using Vec3f = openvdb::Vec3s;

Drops::Drops(std::vector<Drop> drops, float voxel) : voxel_(voxel), drops_(std::move(drops)) {
    // What is thinner than a voxel keeps its water, not its width.
    const float least = 0.7F * voxel_;
    for (Drop& drop : drops_) {
        if (drop.radius >= least) continue;
        const float ratio = drop.radius / least;
        drop.amount *= ratio * ratio * ratio;
        drop.radius = least;
    }

    for (std::size_t i = 0; i < drops_.size(); ++i) {
        const Drop& drop = drops_[i];
        const Vec3f margin(drop.radius + voxel_);
        const Vec3f low = openvdb::math::minComponent(drop.head, drop.tail) - margin;
        const Vec3f high = openvdb::math::maxComponent(drop.head, drop.tail) + margin;
        for (int x = leaf_at(low.x(), voxel_); x <= leaf_at(high.x(), voxel_); x += kLeafSide) {
            for (int y = leaf_at(low.y(), voxel_); y <= leaf_at(high.y(), voxel_); y += kLeafSide) {
                for (int z = leaf_at(low.z(), voxel_); z <= leaf_at(high.z(), voxel_);
                     z += kLeafSide) {
                    shares_.push_back({Coord(x, y, z), static_cast<std::uint32_t>(i)});
                }
            }
        }
    }
    tbb::parallel_sort(shares_.begin(), shares_.end(), [](const Share& a, const Share& b) {
        return std::tie(a.leaf, a.drop) < std::tie(b.leaf, b.drop);
    });
}

std::vector<Coord> Drops::leaves() const {
    std::vector<Coord> all;
    for (const Share& share : shares_) {
        if (all.empty() || all.back() != share.leaf) all.push_back(share.leaf);
    }
    return all;
}

float Drops::reach(const Drop& drop) const {
    return drop.kind == Kind::kDrop ? drop.radius + 0.4F * voxel_ : drop.radius;
}

Drops::Range Drops::covered(const Coord& origin, const Drop& drop) const {
    const Vec3f base = place(origin, voxel_);
    Range range;
    for (int a = 0; a < 3; ++a) {
        const float from = std::min(drop.head[a], drop.tail[a]) - reach(drop) - base[a];
        const float to = std::max(drop.head[a], drop.tail[a]) + reach(drop) - base[a];
        range.low[a] = std::max(0, static_cast<int>(std::ceil(from / voxel_)));
        range.high[a] = std::min(kLeafSide - 1, static_cast<int>(std::floor(to / voxel_)));
    }
    return range;
}

float Drops::density_at(const Drop& drop, const Coord& origin, int x, int y, int z) const {
    const Vec3f p = place(origin, voxel_) + place(Coord(x, y, z), voxel_);
    const Vec3f axis = drop.tail - drop.head;
    const float length = axis.lengthSqr();
    const float inverse = length > 0.0F ? 1.0F / length : 0.0F;
    const float t = std::clamp((p - drop.head).dot(axis) * inverse, 0.0F, 1.0F);
    const float square = (p - drop.head - axis * t).lengthSqr();
    const float far = reach(drop);
    if (square >= far * far) return 0.0F;
    if (drop.kind == Kind::kDrop) {
        return drop.amount * std::min(1.0F, (far - std::sqrt(square)) / voxel_);
    }
    const float k = 1.0F - square / (far * far);
    return drop.amount * (k * k);
}

}  // namespace pileus::make
