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
    float scale() const { return scale_; }  // 4 pi / (1 - g^2)

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

    struct Sample {
        V3f direction;
        float inverse_density;
    };

    /// A direction drawn from `density`, from u1, u2 in [0, 1).
    Sample sample(const V3f& in, float u1, float u2) const {
        const auto [direction, inverse_density] = deflection(u1, u2);
        return {turned(in, direction), inverse_density};
    }

    /// The same about the z axis, for light that came along it if g >= 0 and against it if not: the
    /// inversion of the distribution, rearranged so that nothing cancels and g = 0 needs no case.
    Sample deflection(float u1, float u2) const {
        const float g = std::abs(g_);
        const float ratio = (1.0f - g) / (1.0f - g + 2.0f * g * u1);
        const float one_minus_cos = 2.0f * (1.0f - u1) * (1.0f + g * u1) * ratio * ratio;
        const float root = (1.0f + g) * ratio;  // of 1 + g^2 - 2 g cos(theta)
        return {from_pole(one_minus_cos, u2), scale_ * root * root * root};
    }

    /// A deflection, of light that came along `in`.
    V3f turned(const V3f& in, const V3f& deflected) const {
        return turned_to(g_ >= 0.0f ? in : -in, deflected);
    }

  private:
    float g_;
    float scale_;
};

}  // namespace pileus
