// The distance field of a heap of puffs is displaced by octaves of rounded Worley billows, each
// octave growing on the crowns of the one before, which gives cauliflower with sharp creases; the
// side the wind comes from is eroded into wisps.
#include "cloud.h"

#include "cache.h"
#include "heap.h"
#include "noise.h"

#include <openvdb/openvdb.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <iterator>
#include <limits>
#include <vector>

namespace pileus {
namespace {

using make::kBase;
using make::kBlockSide;
using make::kLeafSide;
using make::kLeafVoxels;
using make::Puff;
using noise::Points;
using noise::smoothstep;
using noise::Values;
using openvdb::Coord;
using Vec3f = openvdb::Vec3s;

constexpr float kWind = 0.07F;            // drift along x, world units per second
constexpr float kUpdraft = 0.075F;        // billows climb through the heap
constexpr float kLargestBillow = 0.115F;  // cell of the first octave
constexpr float kBillow = 0.52F;          // height of a billow in cells
constexpr int kMostOctaves = 8;
constexpr float kBlend = 0.018F;  // puffs melt together over this length
constexpr float kVeil = 0.04F;    // wisps trail this far out
constexpr float kReach = 0.09F;   // billows and wisps together go no further out
constexpr float kBite = 0.08F;    // and erosion no further in

// Joins two distances with a fillet of width `k`.
float fillet(float a, float b, float k) {
    const float h = std::max(k - std::abs(a - b), 0.0F);
    return std::min(a, b) - h * h / (4.0F * k);
}

// A turn by an odd angle about an odd axis: applied between octaves, it keeps their lattices from
// showing as rows.
void turn(Points& p) {
    for (std::size_t i = 0; i < noise::kBatch; ++i) {
        const float x = p.x[i];
        const float y = p.y[i];
        const float z = p.z[i];
        p.x[i] = 0.80F * y + 0.60F * z;
        p.y[i] = -0.80F * x + 0.36F * y - 0.48F * z;
        p.z[i] = -0.60F * x - 0.48F * y + 0.64F * z;
    }
}

class Cumulus {
  public:
    explicit Cumulus(const MakeOptions& options)
        : seed_(noise::fold(options.seed)),
          voxel_(1.0F / static_cast<float>(options.resolution)),
          // Time zero is the middle of the sequence, so that the cloud drifts through the frame.
          time_((static_cast<float>(options.frame) -
                 0.5F * (static_cast<float>(options.frames) + 1.0F)) /
                kFramesPerSecond),
          puffs_(make::heap(seed_, time_)) {
        // Detail goes down to what the voxels can hold.
        float cell = kLargestBillow;
        for (int i = 0; i < kMostOctaves && cell > 2.6F * voxel_; ++i) {
            billows_.emplace_back(cell, time_ * (0.9F + 0.25F * static_cast<float>(i)),
                                  noise::combine(seed_, 100U + static_cast<std::uint32_t>(i)));
            cell *= 0.47F;
        }
    }

    float voxel() const { return voxel_; }

    // Origins of the leaves that can hold density: whole bricks are ruled out first.
    std::vector<Coord> leaves() const {
        constexpr int kBrick = 4 * kLeafSide;
        Vec3f low(1e9F);
        Vec3f high(-1e9F);
        for (const Puff& p : puffs_) {
            low = openvdb::math::minComponent(low, p.centre - Vec3f(p.radius));
            high = openvdb::math::maxComponent(high, p.centre + Vec3f(p.radius));
        }
        const Vec3f drift(kWind * time_, 0.0F, 0.0F);
        low += drift - Vec3f(reach());
        high += drift + Vec3f(reach());
        const auto brick_of = [&](float x) {
            return static_cast<int>(std::floor(x / (voxel_ * kBrick)));
        };
        std::vector<Coord> bricks;
        for (int x = brick_of(low.x()); x <= brick_of(high.x()); ++x) {
            for (int y = brick_of(low.y()); y <= brick_of(high.y()); ++y) {
                for (int z = brick_of(low.z()); z <= brick_of(high.z()); ++z) {
                    bricks.emplace_back(x * kBrick, y * kBrick, z * kBrick);
                }
            }
        }
        std::vector<std::vector<Coord>> found(bricks.size());
        tbb::parallel_for(std::size_t{0}, bricks.size(), [&](std::size_t i) {
            const std::vector<Puff> near = around(bricks[i], kBrick, puffs_);
            if (near.empty()) return;
            for (int x = 0; x < kBrick; x += kLeafSide) {
                for (int y = 0; y < kBrick; y += kLeafSide) {
                    for (int z = 0; z < kBrick; z += kLeafSide) {
                        const Coord origin = bricks[i].offsetBy(x, y, z);
                        if (!around(origin, kLeafSide, near).empty()) found[i].push_back(origin);
                    }
                }
            }
        });
        std::vector<Coord> all;
        for (const auto& part : found) all.insert(all.end(), part.begin(), part.end());
        return all;
    }

    bool fill(const Coord& origin, make::LeafValues& values) const {
        values.density.fill(0.0F);
        const std::vector<Puff> near = around(origin, kLeafSide, puffs_);
        bool any = false;
        // Blocks are small enough that few puffs and billows compete in each.
        make::for_each_block(
            origin, [&](const Coord& corner) { any |= fill_block(origin, corner, near, values); });
        if (any) fill_velocity(origin, values);
        return any;
    }

  private:
    // Half the width of a crisp edge.
    float crisp() const { return 1.1F * voxel_; }

    // Nothing is further than this from the nearest puff.
    float reach() const { return kReach + kBlend + crisp(); }

    // Position in the frame that drifts with the cloud.
    Vec3f place(const Coord& ijk) const {
        return make::place(ijk, voxel_) - Vec3f(kWind * time_, 0.0F, 0.0F);
    }

    // The puffs of a list that decide the distance anywhere in a box of voxels; none where the box
    // cannot hold density. Leaving out the others does not change the distance by a bit.
    std::vector<Puff> around(const Coord& origin, int side, const std::vector<Puff>& puffs) const {
        const float half = 0.5F * static_cast<float>(side - 1) * voxel_;
        const float radius = half * 1.7321F;
        const Vec3f centre = place(origin) + Vec3f(half);
        if (centre.y() + half < kBase - reach()) return {};
        const auto distance = [&](const Puff& puff) {
            return (centre - puff.centre).length() - puff.radius;
        };
        float closest = std::numeric_limits<float>::max();
        for (const Puff& puff : puffs) closest = std::min(closest, distance(puff));
        if (closest > radius + reach()) return {};
        std::vector<Puff> near;
        std::copy_if(puffs.begin(), puffs.end(), std::back_inserter(near), [&](const Puff& puff) {
            return distance(puff) < closest + 2.0F * radius + 3.0F * kBlend;
        });
        return near;
    }

    bool fill_block(const Coord& origin, const Coord& corner, const std::vector<Puff>& leaf_puffs,
                    make::LeafValues& values) const {
        const std::vector<Puff> near = around(corner, kBlockSide, leaf_puffs);
        if (near.empty()) return false;

        Points at;
        Values distance;
        for (std::size_t i = 0; i < noise::kBatch; ++i) {
            const Vec3f p = place(make::voxel_of_block(corner, i));
            at.x[i] = p.x();
            at.y[i] = p.y();
            at.z[i] = p.z();
            distance[i] = std::numeric_limits<float>::max();
        }
        for (const Puff& puff : near) {
            for (std::size_t i = 0; i < noise::kBatch; ++i) {
                const float dx = at.x[i] - puff.centre.x();
                const float dy = at.y[i] - puff.centre.y();
                const float dz = at.z[i] - puff.centre.z();
                const float d = std::sqrt(dx * dx + dy * dy + dz * dz) - puff.radius;
                distance[i] = fillet(distance[i], d, kBlend);
            }
        }
        displace(at, distance);

        bool any = false;
        for (std::size_t i = 0; i < noise::kBatch; ++i) {
            const float density = density_at(Vec3f(at.x[i], at.y[i], at.z[i]), distance[i]);
            if (density < make::kFaint) continue;
            any = true;
            const Coord ijk = make::voxel_of_block(corner, i) - origin;
            values.density[make::number_in_leaf(ijk.x(), ijk.y(), ijk.z())] = density;
        }
        return any;
    }

    // Grows billows on the heap, octave by octave, for as long as they can still move the edge.
    void displace(const Points& at, Values& distance) const {
        float growth = 0.0F;
        for (const noise::Worley& octave : billows_) growth += kBillow * octave.cell();
        Points q;
        for (std::size_t i = 0; i < noise::kBatch; ++i) {
            // The billows climb, and space is bent a little so that they are not evenly sown.
            const float x = at.x[i];
            const float y = at.y[i] - kUpdraft * time_;
            const float z = at.z[i];
            q.x[i] = x + 0.022F * noise::wave(1.4F * y + 1.1F * z);
            q.y[i] = y + 0.022F * noise::wave(1.3F * z + 0.9F * x + 0.2F);
            q.z[i] = z + 0.022F * noise::wave(1.4F * x + 1.1F * y + 0.4F);
        }
        Values crown;
        crown.fill(1.0F);
        for (const noise::Worley& octave : billows_) {
            const auto [low, high] = std::minmax_element(distance.begin(), distance.end());
            if (*low > growth + kVeil || *high < -growth - kBite) return;
            turn(q);
            const Values f = octave.nearest_squared(q);
            const float height = kBillow * octave.cell();
            growth -= height;
            for (std::size_t i = 0; i < noise::kBatch; ++i) {
                const float bump = 1.0F - f[i];
                distance[i] -= height * crown[i] * (bump - 0.62F);
                crown[i] *= 0.35F + 0.65F * smoothstep(0.25F, 0.85F, bump);
            }
        }
    }

    // A crisp edge to the lee; to windward, and along the ragged underside, air mixes in: the
    // edge widens, is eaten into and trails veils.
    float density_at(const Vec3f& p, float billowed) const {
        const float under = kBase - p.y();
        const float d = std::max(billowed, under);
        if (d > std::max(kVeil, crisp())) return 0.0F;
        if (d < -std::max(kBite, crisp())) return 1.0F;

        // Patches of the windward side stay crisp; noise is asked only where it can matter.
        const float side = -p.x() - 0.3F * p.y();
        const float windward =
            side < -0.2F
                ? 0.0F
                : smoothstep(0.12F, 0.60F,
                             side + 0.32F * noise::gradient(p * 7.0F, 0.4F * time_, seed_ ^ 0x71U));
        const float ragged = smoothstep(0.05F, 0.0F, p.y() - kBase);
        const float mixing = std::max(0.9F * windward, 0.7F * ragged);
        if (mixing < 0.02F) return smoothstep(crisp(), -crisp(), d);

        const float soft = crisp() + 0.016F * mixing;
        if (d < -soft - 0.06F * mixing) return 1.0F;
        const Vec3f q((p.x() + 0.03F * time_) * 13.0F, p.y() * 19.0F, p.z() * 17.0F);
        const float air = noise::fractal(q, 0.7F * time_, seed_ ^ 0x77U, 3);
        const float eaten = d + mixing * (0.012F + 0.075F * air);
        const float body = smoothstep(soft, -soft, eaten);
        const float veil =
            0.16F * mixing * smoothstep(0.02F, 0.35F, -air) * smoothstep(kVeil, 0.0F, d);
        return std::max(body, veil);
    }

    // Drift, a wind that grows with height, an updraft that is strongest in the core and curls
    // out at the top, and eddies. Smooth, so the corners of a leaf are enough.
    Vec3f wind_at(const Vec3f& p) const {
        const float core = 1.0F - smoothstep(0.0F, 0.5F, std::hypot(p.x(), p.z()));
        const float height = smoothstep(kBase, kBase + 0.5F, p.y());
        Vec3f v(kWind, kUpdraft * core * (1.0F - 0.5F * height), 0.0F);
        v += Vec3f(p.x(), 0.0F, p.z()) * (0.12F * (height - 0.4F));
        const Vec3f q = Vec3f(p.x(), p.y() - kUpdraft * time_, p.z()) * 6.0F;
        v += Vec3f(noise::gradient(q, 0.8F * time_, seed_ ^ 0x11U),
                   noise::gradient(q, 0.8F * time_, seed_ ^ 0x12U),
                   noise::gradient(q, 0.8F * time_, seed_ ^ 0x13U)) *
             0.03F;
        return v;
    }

    void fill_velocity(const Coord& origin, make::LeafValues& values) const {
        std::array<Vec3f, 8> corner;
        for (int c = 0; c < 8; ++c) {
            corner[static_cast<std::size_t>(c)] = wind_at(place(origin.offsetBy(
                (c >> 2) * kLeafSide, ((c >> 1) & 1) * kLeafSide, (c & 1) * kLeafSide)));
        }
        const auto along = [](const Vec3f& a, const Vec3f& b, int t) {
            return a + (b - a) * (static_cast<float>(t) / kLeafSide);
        };
        for (int n = 0; n < kLeafVoxels; ++n) {
            const int x = n >> 6;
            const int y = (n >> 3) & 7;
            const int z = n & 7;
            const Vec3f low =
                along(along(corner[0], corner[1], z), along(corner[2], corner[3], z), y);
            const Vec3f high =
                along(along(corner[4], corner[5], z), along(corner[6], corner[7], z), y);
            values.velocity[static_cast<std::size_t>(n)] = along(low, high, x);
        }
    }

    std::uint32_t seed_;
    float voxel_;
    float time_;
    std::vector<Puff> puffs_;
    std::vector<noise::Worley> billows_;
};

}  // namespace

std::int64_t make_cloud(const std::string& path, const MakeOptions& options) {
    return make::make_cache<Cumulus>(path, options, "pileus make cloud");
}

}  // namespace pileus
