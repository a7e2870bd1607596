// Bridges: the last directions of a path to a distant light, drawn from the light's end. The
// narrow lobe of one event sees such a light seldom and then brightly; where each direction is
// drawn about the one that follows it, the path ends in the light by construction, and one phase
// function further back is left to be evaluated.
#pragma once

#include "light.h"
#include "random.h"

#include <algorithm>
#include <array>
#include <cmath>

namespace pileus {

/// How many events a bridge may have between the walk and the light.
constexpr int longest_bridge = 12;

/// How many are worth it under a phase function: until the directions that go back from the light
/// have spread, their mean cosine to it g^n being small.
inline int bridge_length(float g) {
    constexpr float spread = 0.3f;
    if (g <= spread) return 0;
    return static_cast<int>(
        std::min<float>(longest_bridge, std::ceil(std::log(spread) / std::log(g))));
}

/// The inverse densities of the directions that a walk chose last, summed: of none, of the last
/// one, of the last two, and so on; of no more than there were.
class RecentChoices {
  public:
    void add(float inverse_density) {
        for (std::size_t i = longest_bridge; i > 0; --i) sums_[i] = sums_[i - 1] + inverse_density;
    }

    float inverse(int choices) const { return sums_[static_cast<std::size_t>(choices)]; }

  private:
    std::array<float, longest_bridge + 1> sums_{};
};

/// Directions that lead from a walk into a distant light, as many of the last ones as a bridge has
/// events.
class Chain {
  public:
    /// The directions next to the light come of `last`, two numbers each, the others of `random`.
    Chain(const LightSample& light, const HenyeyGreenstein& phase, int length,
          const std::array<float, 4>& last, Random random)
        : light_(light) {
        std::array<float, longest_bridge> u1{last[0], last[2]}, u2{last[1], last[3]};
        for (std::size_t i = 2; i < static_cast<std::size_t>(length); ++i) {
            const auto pair = random.pair();
            u1[i] = pair[0];
            u2[i] = pair[1];
        }
        // All deflections at once; which way each leads hangs on those before.
        for (std::size_t i = 0; i < longest_bridge; ++i) {
            const auto [direction, inverse_density] = phase.deflection(u1[i], u2[i]);
            direction_[0][i] = direction.x;
            direction_[1][i] = direction.y;
            direction_[2][i] = direction.z;
            inverse_[i] = inverse_density;
        }
        V3f next = light.direction;
        float sum = 0.0f;
        for (std::size_t i = 0; i < static_cast<std::size_t>(length); ++i) {
            next = phase.turned(next, V3f(direction_[0][i], direction_[1][i], direction_[2][i]));
            for (int axis = 0; axis < 3; ++axis) direction_[axis][i] = next[axis];
            inverse_[i] = sum += inverse_[i];
        }
    }

    const LightSample& light() const { return light_; }

    /// The direction in which a bridge with so many events leaves the walk.
    V3f first(int events) const {
        const auto i = static_cast<std::size_t>(events - 1);
        return {direction_[0][i], direction_[1][i], direction_[2][i]};
    }

    /// The inverse densities of its choices, summed.
    float inverse(int events) const { return inverse_[static_cast<std::size_t>(events - 1)]; }

    /// The same and that of `first`, under the phase function of the event that the bridge leaves:
    /// of bridges with 1, 2, ... events.
    std::array<float, longest_bridge> inverses(const HenyeyGreenstein& phase,
                                               const V3f& arriving) const {
        std::array<float, longest_bridge> sums;
        for (std::size_t i = 0; i < sums.size(); ++i) {
            const V3f leaving(direction_[0][i], direction_[1][i], direction_[2][i]);
            sums[i] = inverse_[i] + phase.inverse_density(arriving, leaving);
        }
        return sums;
    }

  private:
    LightSample light_;
    std::array<float, longest_bridge> direction_[3]{}, inverse_{};
};

}  // namespace pileus
