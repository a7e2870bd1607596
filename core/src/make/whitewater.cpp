// A wave runs obliquely into a wall: the burst travels along the front and throws up jets that
// climb, thin out, break into droplets and leave mist, over a churned mound and a sheet of lacing
// foam. Every drop is ballistic with a closed form in time, so any frame can be made alone.
#include "whitewater.h"

#include "blocks.h"
#include "noise.h"

#include <openvdb/openvdb.h>
#include <tbb/parallel_for.h>
#include <tbb/parallel_sort.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <tuple>
#include <utility>
#include <vector>

namespace pileus {
namespace {

using make::kLeafSide;
using make::kLeafVoxels;
using noise::Points;
using noise::Values;
using openvdb::Coord;
using Vec3f = openvdb::Vec3s;

constexpr float kFramesPerSecond = 24.0F;
constexpr float kWater = -0.24F;    // height of the still water
constexpr float kGravity = 5.0F;    // world units per action second squared
constexpr float kFront = 0.86F;     // length of the crashing front along x
constexpr float kSweep = 0.20F;     // the burst runs along the front in this time
constexpr float kShutter = 0.014F;  // drops are drawn out over this time
constexpr float kSheetX = 0.95F;    // half extents of the foam on the water
constexpr float kSheetBack = -0.42F;
constexpr float kSheetFront = 0.55F;
constexpr float kLeastAmount = 1e-4F;
constexpr float kLargestChurn = 0.085F;

// Water in flight, drawn out along its path. A drop has a hard edge; spray is a soft streak of
// drops too small to tell apart; mist hangs in the air, and air tears it.
enum class Kind { kDrop, kSpray, kMist };
struct Drop {
    Vec3f head;
    Vec3f tail;
    float radius;
    float amount;
    Vec3f velocity;
    Kind kind;
};

// A share of a leaf in a drop.
struct Share {
    Coord leaf;
    std::uint32_t drop;
};

float smoothstep(float low, float high, float x) {
    const float t = std::clamp((x - low) / (high - low), 0.0F, 1.0F);
    return t * t * (3.0F - 2.0F * t);
}

class Splash {
  public:
    explicit Splash(const MakeOptions& options)
        : seed_(noise::fold(options.seed)),
          voxel_(1.0F / static_cast<float>(options.resolution)),
          pace_(kAction / static_cast<float>(options.frames) * kFramesPerSecond),
          time_(kStart + kAction * (static_cast<float>(options.frame) - 0.5F) /
                             static_cast<float>(options.frames)) {
        throw_jets();
        throw_mist();
        share_out();
        float cell = kLargestChurn;
        for (int i = 0; i < 6 && cell > 2.6F * voxel_; ++i) {
            churn_.emplace_back(cell, 3.0F * time_,
                                noise::combine(seed_, 200U + static_cast<std::uint32_t>(i)));
            cell *= 0.5F;
        }
    }

    float voxel() const { return voxel_; }

    std::vector<Coord> leaves() const {
        std::vector<Coord> all;
        for (const Share& share : shares_) {
            if (all.empty() || all.back() != share.leaf) all.push_back(share.leaf);
        }
        const auto leaf_of = [&](float x) {
            return static_cast<int>(std::floor(x / (voxel_ * kLeafSide))) * kLeafSide;
        };
        const float half = 0.5F * kLeafSide * voxel_;
        for (int x = leaf_of(-kSheetX); x <= leaf_of(kSheetX); x += kLeafSide) {
            for (int z = leaf_of(kSheetBack); z <= leaf_of(kSheetFront); z += kLeafSide) {
                const Vec3f middle = place(Coord(x, 0, z)) + Vec3f(half);
                const float margin = 0.07F + 2.0F * half;
                const float top = kWater + mound(middle.x(), middle.z()) + margin;
                for (int y = leaf_of(kWater - margin); y <= leaf_of(top); y += kLeafSide) {
                    all.emplace_back(x, y, z);
                }
            }
        }
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

        const auto [first, last] =
            std::equal_range(shares_.begin(), shares_.end(), Share{origin, 0},
                             [](const Share& a, const Share& b) { return a.leaf < b.leaf; });
        for (auto share = first; share != last; ++share) {
            const Drop& drop = drops_[share->drop];
            splat(origin, drop, [&](std::size_t i, float density) {
                (drop.kind == Kind::kMist ? mist : water)[i] += density;
                weight[i] += density;
                momentum[i] += drop.velocity * density;
            });
        }
        fill_water(origin, values, weight, momentum);
        for (std::size_t i = 0; i < kLeafVoxels; ++i) {
            if (mist[i] > 0.0F) {
                const Vec3f p = place(make::voxel_of(origin, static_cast<int>(i)));
                const float torn = noise::fractal((p - Vec3f(0.0F, 0.25F * time_, 0.0F)) * 13.0F,
                                                  2.0F * time_, seed_ ^ 0x33U, 4);
                // Air tears the mist: thin places open first.
                mist[i] = std::max(0.0F, mist[i] * (1.0F + 1.6F * torn) - 0.006F * (0.35F - torn));
            }
            values.density[i] = std::min(1.0F, values.density[i] + water[i] + mist[i]);
            values.velocity[i] = weight[i] > 0.0F ? momentum[i] * (pace_ / weight[i]) : Vec3f(0.0F);
        }
        return true;
    }

  private:
    // The part of the action that a sequence shows, in action seconds.
    static constexpr float kStart = 0.10F;
    static constexpr float kAction = 0.70F;

    Vec3f place(const Coord& ijk) const {
        return Vec3f(static_cast<float>(ijk.x()), static_cast<float>(ijk.y()),
                     static_cast<float>(ijk.z())) *
               voxel_;
    }

    // Along the front u runs from 0 to 1.
    static float along(float x) { return x / kFront + 0.5F; }
    float burst_time(float u) const { return kSweep * u; }

    // How hard the wave hits at u: one high place and lesser ones beside it.
    float force(float u) const {
        const float hero = (u - 0.40F) / 0.21F;
        const float second = (u - 0.80F) / 0.11F;
        const float shape =
            0.30F + 0.62F * std::exp(-hero * hero) + 0.22F * std::exp(-second * second);
        return shape * (0.72F + 0.5F * noise::value(u * 11.0F, seed_ ^ 0x41U));
    }

    // Water leaves the front in jets, a jet splits into strands, a strand into drops. The random
    // numbers of a drop are drawn whether or not it is in flight: it is the same in every frame.
    void throw_jets() {
        constexpr int kJets = 64;
        constexpr int kStrands = 20;
        for (int j = 0; j < kJets; ++j) {
            noise::Random random(noise::combine(seed_ ^ 0x1000U, static_cast<std::uint32_t>(j)));
            const float u = (static_cast<float>(j) + random()) / kJets;
            const float speed = 2.30F * force(u) * random(0.66F, 1.10F);
            const float tilt = 0.85F * (u - 0.46F) +
                               0.35F * (noise::value(u * 9.0F, seed_ ^ 0x42U) - 0.5F) +
                               0.08F * random.bell();
            const float toward = 0.10F + 0.10F * random.bell();
            for (int k = 0; k < kStrands; ++k) {
                const float at = u + 0.012F * random.bell();
                const Vec3f foot((at - 0.5F) * kFront, kWater, 0.022F * random.bell());
                const float aside = 0.055F * random.bell();
                const Vec3f lean(tilt + aside, 1.0F, toward + 0.055F * random.bell());
                throw_strand(random, foot, lean * (speed * random(0.55F, 1.05F)),
                             time_ - burst_time(at));
            }
        }
    }

    // The rank of a drop runs from the slow water at the foot of its strand, which keeps welling
    // up, to the fast tip, which left first.
    void throw_strand(noise::Random& random, const Vec3f& foot, const Vec3f& start, float age) {
        constexpr int kDrops = 200;
        const auto beads = static_cast<std::uint32_t>(random() * 1.0e6F);
        const float girth = random(0.6F, 1.25F);
        for (int i = 0; i < kDrops; ++i) {
            const float rank = (static_cast<float>(i) + random()) / kDrops;
            const Vec3f apart = random.bells();
            const float size = random();
            // Some drops are torn off early and stray.
            const bool stray = random() < 0.12F + 0.25F * rank;

            const float flight = age - 0.25F * (1.0F - rank);
            if (flight <= 0.0F) continue;
            const float scatter = stray ? 0.05F + 0.20F * rank : 0.012F + 0.035F * rank * rank;
            const Vec3f out =
                start * (0.20F + 0.80F * rank) + apart * (scatter * (0.3F + start.y() * 0.6F));
            const Vec3f velocity = out - Vec3f(0.0F, kGravity * flight, 0.0F);
            const Vec3f at =
                foot + out * flight - Vec3f(0.0F, 0.5F * kGravity * flight * flight, 0.0F);
            if (at.y() < kWater - 0.02F) continue;

            if (stray) {
                add({at, at - velocity * kShutter, 0.0005F + 0.0022F * std::pow(size, 6.0F), 1.0F,
                     velocity, Kind::kDrop});
                continue;
            }
            // A strand leaves as solid water, parts between its beads as it thins, and breaks into
            // drops; what it sheds in between is gone within a moment.
            const float whole = 0.06F + 0.22F * size * (1.0F - 0.5F * rank);
            if (flight > whole) {
                break_up(noise::combine(beads, static_cast<std::uint32_t>(i)), at, velocity,
                         flight - whole);
            }
            const float bead = noise::value(rank * 22.0F, beads);
            const float swell = 1.0F + 1.2F * smoothstep(0.0F, 0.5F, flight);
            const float parted = smoothstep(0.02F, 0.45F, flight);
            const float shed = std::exp(-std::max(0.0F, flight - whole) / 0.07F);
            const float amount = shed *
                                 std::clamp(1.5F * bead + 0.5F - 1.2F * parted, 0.02F, 1.0F) /
                                 (swell * swell * swell);
            if (amount < kLeastAmount) continue;
            const float radius = girth * swell * (0.0065F - 0.0028F * rank) * (0.5F + 0.7F * size);
            add({at, at - velocity * (2.0F * kShutter), radius, amount, velocity, Kind::kSpray});
        }
    }

    // A piece of a strand becomes drops, many small and few large, that part from each other.
    void break_up(std::uint32_t seed, const Vec3f& middle, const Vec3f& velocity, float since) {
        constexpr int kPieces = 3;
        noise::Random random(seed);
        for (int i = 0; i < kPieces; ++i) {
            const Vec3f apart = random.bells() * 0.11F;
            const float size = random();
            const Vec3f at = middle + apart * since;
            if (at.y() < kWater - 0.02F) continue;
            const Vec3f flying = velocity + apart;
            const float radius = 0.0006F + 0.0030F * std::pow(size, 5.0F);
            add({at, at - flying * kShutter, radius, 1.0F, flying, Kind::kDrop});
        }
    }

    void throw_mist() {
        constexpr int kPuffs = 7000;
        constexpr float kDrag = 4.2F;
        noise::Random random(noise::combine(seed_, 0x2000U));
        for (int i = 0; i < kPuffs; ++i) {
            const float u = random();
            const float rank = random();
            const Vec3f apart = random.bells();
            const float size = random();
            const float late = 0.30F * random();
            const float age = time_ - burst_time(u) - late;
            if (age <= 0.0F) continue;
            const Vec3f lean(1.05F * (u - 0.46F), 1.0F, 0.10F);
            const Vec3f start = lean * (2.7F * force(u) * (0.25F + 0.75F * rank)) + apart * 0.22F;
            // Air stops the mist within a moment; then it hangs, sinks and drifts downwind.
            const float carried = (1.0F - std::exp(-kDrag * age)) / kDrag;
            const Vec3f fall(0.10F, -0.28F, 0.02F);
            const Vec3f at = Vec3f((u - 0.5F) * kFront, kWater + 0.02F, 0.0F) + start * carried +
                             fall * (age - carried);
            const Vec3f velocity =
                start * std::exp(-kDrag * age) + fall * (1.0F - std::exp(-kDrag * age));
            if (at.y() < kWater) continue;
            const float radius = (0.014F + 0.034F * size * size) * (0.6F + 1.1F * age);
            const float amount =
                0.0022F * smoothstep(0.0F, 0.06F, age) * (1.0F - smoothstep(0.20F, 0.75F, age));
            if (amount > 0.0F) add({at, at, radius, amount, velocity, Kind::kMist});
        }
    }

    void add(Drop drop) {
        // What is thinner than a voxel keeps its water, not its width.
        const float least = 0.7F * voxel_;
        if (drop.radius < least) {
            const float ratio = drop.radius / least;
            drop.amount *= ratio * ratio * ratio;
            drop.radius = least;
        }
        drops_.push_back(drop);
    }

    // Lists for each leaf the drops that reach into it, in the order of the drops.
    void share_out() {
        const auto leaf_of = [&](float x) {
            return static_cast<int>(std::floor(x / (voxel_ * kLeafSide))) * kLeafSide;
        };
        for (std::size_t i = 0; i < drops_.size(); ++i) {
            const Drop& drop = drops_[i];
            const Vec3f reach(drop.radius + voxel_);
            const Vec3f low = openvdb::math::minComponent(drop.head, drop.tail) - reach;
            const Vec3f high = openvdb::math::maxComponent(drop.head, drop.tail) + reach;
            for (int x = leaf_of(low.x()); x <= leaf_of(high.x()); x += kLeafSide) {
                for (int y = leaf_of(low.y()); y <= leaf_of(high.y()); y += kLeafSide) {
                    for (int z = leaf_of(low.z()); z <= leaf_of(high.z()); z += kLeafSide) {
                        shares_.push_back({Coord(x, y, z), static_cast<std::uint32_t>(i)});
                    }
                }
            }
        }
        tbb::parallel_sort(shares_.begin(), shares_.end(), [](const Share& a, const Share& b) {
            return std::tie(a.leaf, a.drop) < std::tie(b.leaf, b.drop);
        });
    }

    // Calls `put(voxel, density)` for each voxel of the leaf that the drop covers.
    template <typename Put>
    void splat(const Coord& origin, const Drop& drop, const Put& put) const {
        const Vec3f base = place(origin);
        const Vec3f axis = drop.tail - drop.head;
        const float length = axis.lengthSqr();
        const float inverse = length > 0.0F ? 1.0F / length : 0.0F;
        const float reach = drop.kind == Kind::kDrop ? drop.radius + 0.4F * voxel_ : drop.radius;
        std::array<int, 3> low{};
        std::array<int, 3> high{};
        for (int a = 0; a < 3; ++a) {
            const float from = std::min(drop.head[a], drop.tail[a]) - reach - base[a];
            const float to = std::max(drop.head[a], drop.tail[a]) + reach - base[a];
            const auto i = static_cast<std::size_t>(a);
            low[i] = std::max(0, static_cast<int>(std::ceil(from / voxel_)));
            high[i] = std::min(kLeafSide - 1, static_cast<int>(std::floor(to / voxel_)));
        }
        for (int x = low[0]; x <= high[0]; ++x) {
            for (int y = low[1]; y <= high[1]; ++y) {
                for (int z = low[2]; z <= high[2]; ++z) {
                    const Vec3f p = base + Vec3f(static_cast<float>(x), static_cast<float>(y),
                                                 static_cast<float>(z)) *
                                               voxel_;
                    const float t = std::clamp((p - drop.head).dot(axis) * inverse, 0.0F, 1.0F);
                    const float square = (p - drop.head - axis * t).lengthSqr();
                    if (square >= reach * reach) continue;
                    float density = drop.amount;
                    if (drop.kind != Kind::kDrop) {
                        const float k = 1.0F - square / (reach * reach);
                        density *= k * k;
                    } else {
                        density *= std::min(1.0F, (reach - std::sqrt(square)) / voxel_);
                    }
                    put(static_cast<std::size_t>((x << 6) | (y << 3) | z), density);
                }
            }
        }
    }

    // Height of the aerated mound that the burst heaves up.
    float mound(float x, float z) const {
        const float u = along(x);
        const float ends = smoothstep(-0.10F, 0.12F, u) * smoothstep(1.10F, 0.88F, u);
        const float age = time_ - burst_time(std::clamp(u, 0.0F, 1.0F));
        if (ends <= 0.0F || age <= -0.1F) return 0.0F;
        const float rise =
            smoothstep(-0.1F, 0.14F, age) * (1.0F - 0.65F * smoothstep(0.25F, 0.75F, age));
        const float width = 0.085F + 0.10F * std::max(0.0F, age);
        const float across = (z - 0.05F * std::max(0.0F, age)) / width;
        return 0.12F * ends * rise * (0.45F + 0.55F * force(u)) /
               (1.0F + across * across * across * across);
    }

    // Upward speed of the mound's water, for the velocity grid.
    Vec3f water_velocity(const Vec3f& p) const {
        const float age = time_ - burst_time(std::clamp(along(p.x()), 0.0F, 1.0F));
        const float heave = mound(p.x(), p.z()) * (age < 0.14F ? 6.0F : -1.2F);
        return {0.10F, heave, 0.05F};
    }

    void fill_water(const Coord& origin, make::LeafValues& values,
                    std::array<float, kLeafVoxels>& weight,
                    std::array<Vec3f, kLeafVoxels>& momentum) const {
        constexpr int kBlockSide = 4;
        for (int block = 0; block < 8; ++block) {
            const Coord corner = Coord((block >> 2) * kBlockSide, ((block >> 1) & 1) * kBlockSide,
                                       (block & 1) * kBlockSide);
            const float half = 0.5F * kBlockSide * voxel_;
            const Vec3f middle = place(origin + corner) + Vec3f(half);
            const float level = middle.y() - kWater;
            if (level > 0.11F + half + mound(middle.x(), middle.z()) || level < -0.11F - half) {
                continue;
            }
            Points at;
            for (std::size_t i = 0; i < noise::kBatch; ++i) {
                const auto n = static_cast<int>(i);
                const Vec3f p = place(origin + corner.offsetBy(n >> 4, (n >> 2) & 3, n & 3));
                at.x[i] = p.x();
                at.y[i] = p.y();
                at.z[i] = p.z();
            }
            const Values density = water_at(at);
            for (std::size_t i = 0; i < noise::kBatch; ++i) {
                if (density[i] <= 0.0F) continue;
                const auto n = static_cast<int>(i);
                const Coord ijk = corner.offsetBy(n >> 4, (n >> 2) & 3, n & 3);
                const auto voxel =
                    static_cast<std::size_t>((ijk.x() << 6) | (ijk.y() << 3) | ijk.z());
                values.density[voxel] = std::max(values.density[voxel], density[i]);
                weight[voxel] += density[i];
                momentum[voxel] += water_velocity(Vec3f(at.x[i], at.y[i], at.z[i])) * density[i];
            }
        }
    }

    // Density of mound and foam sheet.
    Values water_at(const Points& at) const {
        Values heave;
        Values height;
        Points q;
        for (std::size_t i = 0; i < noise::kBatch; ++i) {
            heave[i] = mound(at.x[i], at.z[i]);
            const float swell =
                0.012F * noise::wave(0.9F * at.x[i] + 0.5F * at.z[i] - 0.8F * time_) +
                0.008F * noise::wave(1.9F * at.z[i] - 0.7F * at.x[i] - 1.1F * time_ + 0.3F);
            height[i] = kWater + swell + heave[i];
            q.x[i] = at.x[i] - 0.10F * time_;
            // Churned water is drawn upward: billows taller than wide.
            q.y[i] = 0.8F * (at.y[i] - 0.5F * time_);
            q.z[i] = at.z[i] - 0.05F * time_;
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
            flat.x[i] = at.x[i] - 0.10F * time_ + 0.03F * noise::wave(2.1F * at.z[i]);
            flat.y[i] = 0.02F;
            flat.z[i] = at.z[i] - 0.05F * time_ + 0.03F * noise::wave(1.7F * at.x[i] + 0.2F);
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

    std::uint32_t seed_;
    float voxel_;
    float pace_;  // action seconds per second of film
    float time_;  // action seconds since the first touch
    std::vector<Drop> drops_;
    std::vector<Share> shares_;
    std::vector<noise::Worley> churn_;
    std::array<noise::Worley, 2> lace_{noise::Worley(0.11F, 0.8F * time_, seed_ ^ 0x61U),
                                       noise::Worley(0.045F, 1.2F * time_, seed_ ^ 0x62U)};
};

}  // namespace

std::int64_t make_whitewater(const std::string& path, const MakeOptions& options) {
    validate(options);
    openvdb::initialize();
    const Splash splash(options);
    make::Cache cache(splash.voxel());
    cache.fill_leaves(splash.leaves(), [&](const Coord& origin, make::LeafValues& values) {
        return splash.fill(origin, values);
    });
    return cache.write(path, options, "pileus make whitewater");
}

}  // namespace pileus
