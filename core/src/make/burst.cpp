// The burst's force and its mound.
#include "burst.h"

#include <algorithm>
#include <cmath>

namespace pileus::make {

using noise::smoothstep;

float Burst::force(float u) const {
    const float hero = (u - 0.40F) / 0.21F;
    const float second = (u - 0.80F) / 0.11F;
    const float shape = 0.30F + 0.62F * std::exp(-hero * hero) + 0.22F * std::exp(-second * second);
    return shape * (0.72F + 0.5F * noise::value(u * 11.0F, seed_ ^ 0x41U));
}

float Burst::mound(float x, float z) const {
    const float u = along(x);
    const float ends = smoothstep(-0.10F, 0.12F, u) * smoothstep(1.10F, 0.88F, u);
    const float age = this->age(std::clamp(u, 0.0F, 1.0F));
    if (ends <= 0.0F || age <= -0.1F) return 0.0F;
    const float rise =
        smoothstep(-0.1F, 0.14F, age) * (1.0F - 0.65F * smoothstep(0.25F, 0.75F, age));
    const float width = 0.085F + 0.10F * std::max(0.0F, age);
    const float across = (z - 0.05F * std::max(0.0F, age)) / width;
    return 0.12F * ends * rise * (0.45F + 0.55F * force(u)) /
           (1.0F + across * across * across * across);
}

Burst::Vec3f Burst::mound_velocity(const Vec3f& p) const {
    const float age = this->age(std::clamp(along(p.x()), 0.0F, 1.0F));
    const float heave = mound(p.x(), p.z()) * (age < 0.14F ? 6.0F : -1.2F);
    return {0.10F, heave, 0.05F};
}

}  // namespace pileus::make
