// The vector types of the renderer (Imath's) and the few functions on them that Imath does not
// have.
#pragma once

#include <Imath/ImathMatrix.h>
#include <Imath/ImathVec.h>

#include <algorithm>
#include <cmath>
#include <numbers>
#include <utility>

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

/// Sine and cosine of so many turns, in [0, 1], to two units in the last place of 1.
inline std::pair<float, float> sine_cosine(float turns) {
    // About the nearest quarter turn, by Taylor's series; then as many quarters further.
    const float quarters = 4.0f * turns;
    const int quarter = static_cast<int>(quarters + 0.5f);
    const float x = (quarters - static_cast<float>(quarter)) * (0.5f * pi);
    const float z = x * x;
    const float sine =
        x * (1.0f + z * (-1.0f / 6 + z * (1.0f / 120 + z * (-1.0f / 5040 + z / 362880))));
    const float cosine = 1.0f + z * (-1.0f / 2 + z * (1.0f / 24 + z * (-1.0f / 720 + z / 40320)));
    const float along = quarter & 1 ? cosine : sine, across = quarter & 1 ? sine : cosine;
    return {quarter & 2 ? -along : along, (quarter + 1) & 2 ? -across : across};
}

/// The unit vector at angle theta from the unit vector w and so many turns about it, given 1 -
/// cos(theta): that difference, unlike the cosine, keeps its precision for small angles.
inline V3f direction_about(const V3f& w, float one_minus_cos, float turns) {
    V3f u, v;
    make_frame(w, u, v);
    const float radius = std::sqrt(std::max(0.0f, one_minus_cos * (2.0f - one_minus_cos)));
    const auto [sine, cosine] = sine_cosine(turns);
    const V3f d = w * (1.0f - one_minus_cos) + u * (radius * cosine) + v * (radius * sine);
    // So close to length 1 that a step of Newton's method makes it so. Without it a long walk's
    // errors would add up.
    return d * (1.5f - 0.5f * d.length2());
}

inline float luminance(const Color& c) { return 0.2126f * c.x + 0.7152f * c.y + 0.0722f * c.z; }

inline float max_component(const Color& c) { return std::max(c.x, std::max(c.y, c.z)); }

}  // namespace pileus
