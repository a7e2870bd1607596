// The vector types of the renderer (Imath's) and the few functions on them that Imath does not
// have.
#pragma once

#include <Imath/ImathMatrix.h>
#include <Imath/ImathVec.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <numbers>

namespace pileus {

using Imath::V3d;
using Imath::V3f;
using Imath::V3i;
using Color = Imath::V3f;  // linear Rec. 709

constexpr float pi = std::numbers::pi_v<float>;

/// Two unit vectors that make a right-handed frame with the unit vector w (Duff et al. 2017).
inline void make_frame(const V3f& w, V3f& u, V3f& v) {
    const float sign = std::copysign(1.0f, w.z);
    const float a = -1.0f / (sign + w.z);
    const float b = w.x * w.y * a;
    u = V3f(1.0f + sign * w.x * w.x * a, sign * b, -sign * w.x);
    v = V3f(b, sign + w.y * w.y * a, -w.y);
}

/// The sine of so many turns, in [-1, 1], to two units in the last place of 1. Without a branch, so
/// that compilers can take several at once.
inline float sine(float turns) {
    // About the nearest half turn, by Taylor's series.
    const int half = static_cast<int>(2.0f * turns + 2.5f) - 2;
    const float x = (turns - 0.5f * static_cast<float>(half)) * (2.0f * pi);
    const float z = x * x;
    const float value =
        x * (1.0f + z * (-1.0f / 6 + z * (1.0f / 120 + z * (-1.0f / 5040 +
                                                            z * (1.0f / 362880 - z / 39916800)))));
    return std::bit_cast<float>(std::bit_cast<std::uint32_t>(value) ^
                                static_cast<std::uint32_t>(half) << 31);
}

inline float cosine(float turns) { return sine(0.25f - turns); }

/// The unit vector at angle theta from the z axis and so many turns about it, given 1 - cos(theta):
/// that difference, unlike the cosine, keeps its precision for small angles.
inline V3f from_pole(float one_minus_cos, float turns) {
    // Rounding may have left the difference a little over 2.
    const float radius = std::sqrt(std::max(0.0f, one_minus_cos * (2.0f - one_minus_cos)));
    return {radius * cosine(turns), radius * sine(turns), 1.0f - one_minus_cos};
}

/// A unit vector, turned as the z axis would have to be to become the unit vector w.
inline V3f turned_to(const V3f& w, const V3f& direction) {
    V3f u, v;
    make_frame(w, u, v);
    const V3f d = w * direction.z + u * direction.x + v * direction.y;
    // So close to length 1 that a step of Newton's method makes it so. Without it a long walk's
    // errors would add up.
    return d * (1.5f - 0.5f * d.length2());
}

inline float luminance(const Color& c) { return 0.2126f * c.x + 0.7152f * c.y + 0.0722f * c.z; }

inline float max_component(const Color& c) { return std::max(c.x, std::max(c.y, c.z)); }

}  // namespace pileus
