// Thrown water, ballistic but for the mist.
#include "spray.h"

#include "noise.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace pileus::make {
namespace {

using noise::smoothstep;
using Vec3f = openvdb::Vec3s;

constexpr float kGravity = 5.0F;    // world units per action second squared
constexpr float kShutter = 0.007F;  // drops are drawn out over this time
const Vec3f kWind(0.10F, 0.0F, 0.02F);
constexpr float kLeastAmount = 1e-4F;

struct Motion {
    Vec3f at;
    Vec3f velocity;
};

// Flight through air that takes speed at the rate `drag`, until the velocity is `terminal`.
Motion fly(const Vec3f& from, const Vec3f& start, float drag, const Vec3f& terminal, float time) {
    const float kept = std::exp(-drag * time);
    const Vec3f excess = start - terminal;
    return {from + terminal * time + excess * ((1.0F - kept) / drag), terminal + excess * kept};
}

// The same for water that falls.
Motion fall(const Vec3f& from, const Vec3f& start, float drag, float time) {
    return fly(from, start, drag, kWind - Vec3f(0.0F, kGravity / drag, 0.0F), time);
}

class Spray {
  public:
    explicit Spray(const Burst& burst) : burst_(burst), seed_(burst.seed()) { throw_jets(); }

    std::vector<Drop> take() { return std::move(thrown_); }

  private:
    // Water leaves the front in jets, a jet splits into strands, a strand into drops. The random
    // numbers of a drop are drawn whether or not it is in flight: it is the same in every frame.
    void throw_jets() {
        constexpr int kJets = 64;
        constexpr int kStrands = 20;
        for (int j = 0; j < kJets; ++j) {
            noise::Random random(noise::combine(seed_ ^ 0x1000U, static_cast<std::uint32_t>(j)));
            const float u = (static_cast<float>(j) + random()) / kJets;
            const float speed = 2.30F * burst_.force(u) * random(0.66F, 1.10F);
            const float tilt = 0.85F * (u - 0.46F) +
                               0.35F * (noise::value(u * 9.0F, seed_ ^ 0x42U) - 0.5F) +
                               0.08F * random.bell();
            const float toward = 0.10F + 0.10F * random.bell();
            for (int k = 0; k < kStrands; ++k) {
                const float at = u + 0.012F * random.bell();
                const Vec3f foot((at - 0.5F) * Burst::kFront, Burst::kWater,
                                 0.022F * random.bell());
                const float aside = 0.055F * random.bell();
                const Vec3f lean(tilt + aside, 1.0F, toward + 0.055F * random.bell());
                const Vec3f start = lean * (speed * random(0.55F, 1.05F));
                throw_strand(random, foot, start, burst_.age(at));
                throw_mist(random, foot, start, burst_.age(at));
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
            if (at.y() < Burst::kWater - 0.02F) continue;

            if (stray) {
                thrown_.push_back({at, at - velocity * kShutter,
                                   0.0004F + 0.0010F * std::pow(size, 8.0F), 1.0F, velocity,
                                   Kind::kDrop});
                continue;
            }
            // A strand leaves as solid water, parts between its beads as it thins, and breaks into
            // drops and a veil of finer ones, which air holds back.
            const float whole = 0.06F + 0.22F * size * (1.0F - 0.5F * rank);
            const float since = std::max(0.0F, flight - whole);
            const float bead = noise::value(rank * 22.0F, beads);
            const float left = flight - since;
            const Vec3f broken = out - Vec3f(0.0F, kGravity * left, 0.0F);
            const Vec3f there =
                foot + out * left - Vec3f(0.0F, 0.5F * kGravity * left * left, 0.0F);
            if (since > 0.0F) {
                break_up(noise::combine(beads, static_cast<std::uint32_t>(i)), there, broken,
                         since);
            }
            const Motion veil = fall(there, broken, 2.2F + 2.0F * size, since);
            const float swell = 1.0F + 1.2F * smoothstep(0.0F, 0.5F, flight) + 1.0F * since;
            const float parted = smoothstep(0.02F, 0.45F, flight);
            const float shed = 0.5F * std::exp(-since / 0.07F) + 0.5F * std::exp(-since / 0.28F);
            const float amount = shed *
                                 std::clamp(1.5F * bead + 0.5F - 1.2F * parted, 0.02F, 1.0F) /
                                 (swell * swell * swell);
            if (amount < kLeastAmount || veil.at.y() < Burst::kWater) continue;
            const float radius = girth * swell * (0.0065F - 0.0028F * rank) * (0.5F + 0.7F * size);
            thrown_.push_back({veil.at, veil.at - veil.velocity * (2.0F * kShutter), radius, amount,
                               veil.velocity, Kind::kSpray});
        }
    }

    // A piece of a strand becomes drops, many small and few large, that part from each other; air
    // holds the small ones back.
    void break_up(std::uint32_t seed, const Vec3f& middle, const Vec3f& velocity, float since) {
        constexpr int kPieces = 8;
        noise::Random random(seed);
        for (int i = 0; i < kPieces; ++i) {
            const Vec3f apart = random.bells() * 0.07F;
            const float size = random();
            const float drag = 0.3F + 3.5F * (1.0F - size) * (1.0F - size);
            const Motion flying = fall(middle, velocity + apart, drag, since);
            if (flying.at.y() < Burst::kWater - 0.02F) continue;
            const float radius = 0.0005F + 0.0008F * std::pow(size, 5.0F);
            thrown_.push_back({flying.at, flying.at - flying.velocity * kShutter, radius, 1.0F,
                               flying.velocity, Kind::kDrop});
        }
    }

    // Water too fine to fall: air stops it within a moment; then it hangs, sinks and drifts.
    void throw_mist(noise::Random& random, const Vec3f& foot, const Vec3f& start, float age) {
        constexpr int kPuffs = 28;
        for (int i = 0; i < kPuffs; ++i) {
            const float rank = random();
            const Vec3f apart = random.bells() * 0.16F;
            const float size = random();
            const float drag = random(2.5F, 6.0F);
            const float hanging = age - 0.30F * random();
            if (hanging <= 0.0F) continue;
            const Motion motion = fly(foot, start * (0.25F + 0.65F * rank) + apart, drag,
                                      kWind - Vec3f(0.0F, 0.28F, 0.0F), hanging);
            if (motion.at.y() < Burst::kWater) continue;
            const float radius = (0.008F + 0.024F * size * size) * (0.6F + 1.1F * hanging);
            const float amount = 0.0016F * smoothstep(0.0F, 0.06F, hanging) *
                                 (1.0F - smoothstep(0.20F, 0.75F, hanging));
            if (amount <= 0.0F) continue;
            thrown_.push_back({motion.at, motion.at - motion.velocity * 0.03F, radius, amount,
                               motion.velocity, Kind::kMist});
        }
    }

    const Burst& burst_;
    std::uint32_t seed_;
    std::vector<Drop> thrown_;
};

}  // namespace

std::vector<Drop> throw_spray(const Burst& burst) { return Spray(burst).take(); }

}  // namespace pileus::make
