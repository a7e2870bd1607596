// The vector types of the renderer (Imath's) and the few functions on them that Imath does not
// have.
#pragma once

#include <Imath/ImathMatrix.h>
#include <Imath/ImathVec.h>

#include <cmath>
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

/// The unit vector at angle theta from the unit vector w and azimuth phi about it, given 1 -
/// cos(theta): that difference, unlike the cosine, keeps its precision for small angles.
inline V3f direction_about(const V3f& w, float one_minus_cos, float phi) {
    V3f u, v;
    make_frame(w, u, v);
    const float sine = std::sqrt(std::max(0.0f, one_minus_cos * (2.0f - one_minus_cos)));
    const V3f d =
        w * (1.0f - one_minus_cos) + u * (sine * std::cos(phi)) + v * (sine * std::sin(phi));
    return d * (1.0f / d.length());
}

inline float luminance(const Color& c) { return 0.2126f * c.x + 0.7152f * c.y + 0.0722f * c.z; }

inline float max_component(const Color& c) { return std::max(c.x, std::max(c.y, c.z)); }

}  // namespace pileus
