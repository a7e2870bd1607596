// The shape of mound and foam sheet.
#include "foam.h"

#include <cmath>

namespace pileus::make {

using noise::Points;
using noise::smoothstep;
using noise::Values;
using openvdb::Coord;
using Vec3f = openvdb::Vec3s;

namespace {

constexpr float kSheetX = 0.95F;  // half extents of the foam on the water
constexpr float kSheetBack = -0.42F;
constexpr float kSheetFront = 0.55F;
constexpr float kLargestChurn = 0.085F;

}  // namespace

Foam::Foam(const Burst& burst, float voxel)
    : burst_(burst),
      voxel_(voxel),
      lace_{noise::Worley(0.11F, 0.8F * burst.time(), burst.seed() ^ 0x61U),
            noise::Worley(0.045F, 1.2F * burst.time(), burst.seed() ^ 0x62U)} {
    float cell = kLargestChurn;
    for (int i = 0; i < 6 && cell > 2.6F * voxel_; ++i) {
        churn_.emplace_back(cell, 3.0F * burst.time(),
                            noise::combine(burst.seed(), 200U + static_cast<std::uint32_t>(i)));
        cell *= 0.5F;
    }
}

std::vector<Coord> Foam::leaves() const {
    std::vector<Coord> all;
    const auto leaf = [&](float x) { return leaf_at(x, voxel_); };
    const float half = 0.5F * kLeafSide * voxel_;
    for (int x = leaf(-kSheetX); x <= leaf(kSheetX); x += kLeafSide) {
        for (int z = leaf(kSheetBack); z <= leaf(kSheetFront); z += kLeafSide) {
            const Vec3f middle = place(Coord(x, 0, z), voxel_) + Vec3f(half);
            const float margin = 0.07F + 2.0F * half;
            const float top = Burst::kWater + burst_.mound(middle.x(), middle.z()) + margin;
            for (int y = leaf(Burst::kWater - margin); y <= leaf(top); y += kLeafSide) {
                all.emplace_back(x, y, z);
            }
        }
    }
    return all;
}

bool Foam::reaches(const Coord& corner) const {
    const float half = 0.5F * kBlockSide * voxel_;
    const Vec3f middle = place(corner, voxel_) + Vec3f(half);
    const float level = middle.y() - Burst::kWater;
    return level <= 0.11F + half + burst_.mound(middle.x(), middle.z()) && level >= -0.11F - half;
}

Values Foam::density_at(const Points& at) const {
    const float time = burst_.time();
    Values heave;
    Values height;
    Points q;
    for (std::size_t i = 0; i < noise::kBatch; ++i) {
        heave[i] = burst_.mound(at.x[i], at.z[i]);
        const float swell =
            0.012F * noise::wave(0.9F * at.x[i] + 0.5F * at.z[i] - 0.8F * time) +
            0.008F * noise::wave(1.9F * at.z[i] - 0.7F * at.x[i] - 1.1F * time + 0.3F);
        height[i] = Burst::kWater + swell + heave[i];
        q.x[i] = at.x[i] - 0.10F * time;
        // Churned water is drawn upward: billows taller than wide.
        q.y[i] = 0.8F * (at.y[i] - 0.5F * time);
        q.z[i] = at.z[i] - 0.05F * time;
    }
    Values bumps;
    bumps.fill(0.0F);
    Values crown;
    crown.fill(1.0F);
    for (const noise::Worley& octave : churn_) {
        const Values f = octave.nearest_squared(q);
        for (std::size_t i = 0; i < noise::kBatch; ++i) {
            const float bump = 1.0F - f[i];
            bumps[i] += 0.85F * octave.cell() * crown[i] * (bump - 0.6F);
            crown[i] *= 0.4F + 0.6F * bump;
        }
    }
    // Foam on the water: webs between the cells of a flat pattern, fewer away from the burst.
    Points flat;
    for (std::size_t i = 0; i < noise::kBatch; ++i) {
        flat.x[i] = at.x[i] - 0.10F * time + 0.03F * noise::wave(2.1F * at.z[i]);
        flat.y[i] = 0.02F;
        flat.z[i] = at.z[i] - 0.05F * time + 0.03F * noise::wave(1.7F * at.x[i] + 0.2F);
    }
    const Values coarse = lace_[0].nearest_squared(flat);
    const Values fine = lace_[1].nearest_squared(flat);

    Values density;
    for (std::size_t i = 0; i < noise::kBatch; ++i) {
        const float near = smoothstep(0.42F, 0.10F, std::abs(at.z[i] - 0.03F)) *
                           smoothstep(0.90F, 0.45F, std::abs(at.x[i]));
        const float turmoil = 0.25F + 0.75F * std::min(1.0F, heave[i] * 14.0F);
        const float top = height[i] + bumps[i] * turmoil;
        const float depth = (0.014F + 0.05F * near) + heave[i];
        const float above = (at.y[i] - top) / voxel_;
        const float below = (top - depth - at.y[i]) / voxel_;
        const float web = 0.55F * coarse[i] + 0.45F * fine[i];
        const float cover = smoothstep(0.0F, 0.10F, web - 0.52F + 0.75F * near);
        const float edge = std::max(above, below);
        density[i] = cover * smoothstep(1.5F, -1.5F, edge);
    }
    return density;
}

}  // namespace pileus::make
