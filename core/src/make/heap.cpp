// Towers, and the buds on them.
#include "heap.h"

#include "noise.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace pileus::make {

using Vec3f = openvdb::Vec3s;

namespace {

// The towers of a seed as puffs, before any motion, fitted to the frame: a world unit wide, a
// little more than half as high.
std::vector<Puff> towers(noise::Random& random) {
    std::vector<Puff> puffs;
    const float peak = random(-0.12F, 0.10F);
    constexpr int kTowers = 19;
    for (int t = 0; t < kTowers; ++t) {
        // Sunflower order: even over the footprint, nowhere in rows.
        const float angle = 2.39996F * static_cast<float>(t) + random(-0.4F, 0.4F);
        const float ring = std::sqrt((static_cast<float>(t) + 0.2F) / kTowers);
        Vec3f foot(0.43F * ring * std::cos(angle), kBase, 0.31F * ring * std::sin(angle));
        foot.x() += peak * (1.0F - ring);
        // The highest stands off centre, the others fall away around it.
        const float fall = std::hypot((foot.x() - peak) / 0.50F, foot.z() / 0.42F);
        const float height = 0.54F * std::max(0.06F, 1.0F - fall) * random(0.6F, 1.15F);
        float radius = random(0.065F, 0.09F) + 0.16F * height;
        Vec3f at = foot + Vec3f(0.0F, 0.45F * radius, 0.0F);
        const float top = kBase + height;
        for (int level = 0; level < 8; ++level) {
            puffs.push_back({at, radius});
            if (at.y() + radius > top) break;
            const float step = radius * random(0.7F, 0.95F);
            radius *= random(0.80F, 1.0F);
            const float back = random(-0.6F, 0.6F) * step;
            at += Vec3f(random(-0.6F, 0.75F) * step, step, back);
        }
    }

    float left = 1.0F;
    float right = -1.0F;
    float top = kBase;
    for (const Puff& puff : puffs) {
        left = std::min(left, puff.centre.x() - puff.radius);
        right = std::max(right, puff.centre.x() + puff.radius);
        top = std::max(top, puff.centre.y() + puff.radius);
    }
    const float across = 0.98F / (right - left);
    const float up = 0.455F / (top - kBase);
    for (Puff& puff : puffs) {
        puff.centre.x() = (puff.centre.x() - 0.5F * (left + right)) * across;
        puff.centre.y() = kBase + (puff.centre.y() - kBase) * up;
        puff.radius *= 0.5F * (across + up);
    }
    return puffs;
}

}  // namespace

std::vector<Puff> heap(std::uint32_t seed, float time) {
    noise::Random random(noise::combine(seed, 1));
    std::vector<Puff> puffs = towers(random);

    // Each puff breathes at its own pace and climbs a little as it swells.
    const auto move = [&](Puff& puff, float lift) {
        const float pace = random(0.5F, 1.1F);
        const float phase = random(0.0F, 6.2832F);
        const float swell = std::sin(pace * time + phase) - std::sin(phase);
        puff.radius *= 1.0F + 0.06F * swell;
        puff.centre += Vec3f(0.25F, 1.0F, 0.0F) * (lift * 0.045F * swell);
    };
    const std::size_t parents = puffs.size();
    for (Puff& puff : puffs) move(puff, (puff.centre.y() - kBase) / 0.5F);

    // Buds: smaller puffs on the upper and outer sides of the large ones.
    for (std::size_t i = 0; i < parents; ++i) {
        for (int k = 0; k < 12; ++k) {
            const Puff parent = puffs[i];
            Vec3f out = random.direction();
            out.y() = std::abs(out.y()) * 1.1F - 0.15F;
            out.normalize();
            const float radius = parent.radius * random(0.26F, 0.55F);
            Puff bud{parent.centre + out * (parent.radius * random(0.78F, 0.98F)), radius};
            move(bud, 0.5F);
            puffs.push_back(bud);
        }
    }
    return puffs;
}

}  // namespace pileus::make
