// A wave runs obliquely into a wall: the burst travels along the front and throws up spray over a
// churned mound and a sheet of foam. All is a closed form in time, so any frame can be made alone.
#include "whitewater.h"

#include "burst.h"
#include "cache.h"
#include "drops.h"
#include "foam.h"
#include "noise.h"
#include "spray.h"

#include <openvdb/openvdb.h>
#include <tbb/parallel_sort.h>

#include <algorithm>
#include <array>
#include <cstddef>
#include <vector>

namespace pileus {
namespace {

using make::kLeafVoxels;
using openvdb::Coord;
using Vec3f = openvdb::Vec3s;

// The part of the action that a sequence shows, in action seconds since the first touch.
constexpr float kStart = 0.10F;
constexpr float kAction = 0.70F;

class Splash {
  public:
    explicit Splash(const MakeOptions& options)
        : voxel_(1.0F / static_cast<float>(options.resolution)),
          pace_(kAction / static_cast<float>(options.frames) * kFramesPerSecond),
          burst_(noise::fold(options.seed),
                 kStart + kAction * (static_cast<float>(options.frame) - 0.5F) /
                              static_cast<float>(options.frames)),
          drops_(make::throw_spray(burst_), voxel_),
          foam_(burst_, voxel_) {}

    float voxel() const { return voxel_; }

    std::vector<Coord> leaves() const {
        std::vector<Coord> all = drops_.leaves();
        const std::vector<Coord> foam = foam_.leaves();
        all.insert(all.end(), foam.begin(), foam.end());
        tbb::parallel_sort(all.begin(), all.end());
        all.erase(std::unique(all.begin(), all.end()), all.end());
        return all;
    }

    bool fill(const Coord& origin, make::LeafValues& values) const {
        values.density.fill(0.0F);
        std::array<float, kLeafVoxels> weight{};
        std::array<float, kLeafVoxels> water{};
        std::array<float, kLeafVoxels> mist{};
        std::array<Vec3f, kLeafVoxels> momentum;
        momentum.fill(Vec3f(0.0F));

        drops_.splat(origin, [&](const make::Drop& drop, std::size_t i, float density) {
            (drop.kind == make::Kind::kMist ? mist : water)[i] += density;
            weight[i] += density;
            momentum[i] += drop.velocity * density;
        });
        foam_.fill(origin, [&](std::size_t i, float density, const Vec3f& velocity) {
            values.density[i] = density;
            weight[i] += density;
            momentum[i] += velocity * density;
        });
        for (std::size_t i = 0; i < kLeafVoxels; ++i) {
            if (mist[i] > 0.0F) {
                mist[i] = torn(
                    mist[i], make::place(make::voxel_of_leaf(origin, static_cast<int>(i)), voxel_));
            }
            values.density[i] = std::min(1.0F, values.density[i] + water[i] + mist[i]);
            values.velocity[i] = weight[i] > 0.0F ? momentum[i] * (pace_ / weight[i]) : Vec3f(0.0F);
        }
        return true;
    }

  private:
    // Air tears the mist: thin places open first.
    float torn(float mist, const Vec3f& p) const {
        // Falling, it is drawn out into fingers.
        const float time = burst_.time();
        const Vec3f q = (p - Vec3f(0.10F, 0.10F, 0.0F) * time) * Vec3f(21.0F, 12.0F, 21.0F);
        const float air = noise::fractal(q, 2.0F * time, burst_.seed() ^ 0x33U, 5);
        return mist * std::clamp(0.35F + 2.6F * air, 0.0F, 2.0F);
    }

    float voxel_;
    float pace_;  // action seconds per second of film
    make::Burst burst_;
    make::Drops drops_;
    make::Foam foam_;
};

}  // namespace

std::int64_t make_whitewater(const std::string& path, const MakeOptions& options) {
    return make::make_cache<Splash>(path, options, "pileus make whitewater");
}

}  // namespace pileus
