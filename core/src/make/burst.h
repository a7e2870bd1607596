// The course of the burst along the wall, which all of the splash follows: when the front comes to
// a place, how hard it hits there, and the mound that it heaves up. Closed forms in time.
#pragma once

#include "noise.h"

#include <cstdint>

namespace pileus::make {

class Burst {
  public:
    using Vec3f = openvdb::Vec3s;

    static constexpr float kWater = -0.24F;  // height of the still water
    static constexpr float kFront = 0.86F;   // length of the crashing front along x

    // `time` in action seconds since the first touch.
    Burst(std::uint32_t seed, float time) : seed_(seed), time_(time) {}

    std::uint32_t seed() const { return seed_; }
    float time() const { return time_; }

    // Action seconds since the front came to u, which runs from 0 to 1 along it.
    float age(float u) const { return time_ - kSweep * u; }

    // How hard the wave hits at u: one high place and lesser ones beside it.
    float force(float u) const;

    // Height of the aerated mound that the burst heaves up.
    float mound(float x, float z) const;

    // Velocity of the mound's water, per action second.
    Vec3f mound_velocity(const Vec3f& p) const;

  private:
    static constexpr float kSweep = 0.20F;  // the burst runs along the front in this time

    static float along(float x) { return x / kFront + 0.5F; }

    std::uint32_t seed_;
    float time_;
};

}  // namespace pileus::make
