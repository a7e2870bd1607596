// The Henyey-Greenstein phase function (1941): its density and the exact inversion of its
// distribution.
#pragma once

#include "geometry.h"

#include <algorithm>

namespace pileus {

/// Scattering by an angle whose mean cosine is g, in (-1, 1). Directions are unit vectors along the
/// light's travel: before the event and after it.
class HenyeyGreenstein {
  public:
    explicit HenyeyGreenstein(float g)
        : g_(g), scale_(4.0f * pi / ((1.0f - std::abs(g)) * (1.0f + std::abs(g)))) {}

    float g() const { return g_; }

    /// Probability density per steradian of leaving along `out` having come along `in`.
    float density(const V3f& in, const V3f& out) const { return 1.0f / inverse_density(in, out); }

    /// 1 / density, which costs less.
    float inverse_density(const V3f& in, const V3f& out) const {
        // 1 + g^2 - 2 g cos(theta), written about the peak so that g near +-1 does not cancel.
        const float peak = g_ >= 0.0f ? (in - out).length2() : (in + out).length2();
        const float g = std::abs(g_);
        const float base = (1.0f - g) * (1.0f - g) + g * peak;
        return scale_ * base * std::sqrt(base);
    }

    /// A direction drawn from `density`, from u1, u2 in [0, 1).
    V3f sample(const V3f& in, float u1, float u2) const {
        const V3f axis = g_ >= 0.0f ? in : -in;
        return direction_about(axis, one_minus_cos(u1), u2);
    }

  private:
    /// The inversion of the distribution, rearranged so that nothing cancels and g = 0 needs no
    /// case.
    float one_minus_cos(float u) const {
        const float g = std::abs(g_);
        const float d = 1.0f - g + 2.0f * g * u;
        return std::min(2.0f,
                        2.0f * (1.0f - u) * (1.0f + g * u) * ((1.0f - g) / d) * ((1.0f - g) / d));
    }

    float g_;
    float scale_;  // 4 pi / (1 - g^2)
};

}  // namespace pileus
