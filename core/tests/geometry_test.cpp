// The renderer's own sine and cosine against the library's, over all numbers that streams give.
#include "geometry.h"

#include <cmath>
#include <gtest/gtest.h>

namespace pileus {
namespace {

TEST(Geometry, SineAndCosineAreExactToTwoUnits) {
    constexpr double unit = 0x1p-23;  // in the last place of 1
    double sine_error = 0.0, cosine_error = 0.0;
    for (int i = 0; i <= 1 << 24; ++i) {
        const float turns = static_cast<float>(i) * 0x1p-24f;
        const double angle = 2.0 * std::numbers::pi * double{turns};
        const double truth = std::sin(angle);
        sine_error = std::max({sine_error, std::abs(double{sine(turns)} - truth),
                               std::abs(double{sine(-turns)} + truth)});
        cosine_error = std::max(cosine_error, std::abs(double{cosine(turns)} - std::cos(angle)));
    }
    EXPECT_LE(sine_error, 2.0 * unit);
    EXPECT_LE(cosine_error, 2.0 * unit);
}

}  // namespace
}  // namespace pileus
