// What smoothing is said to leave of a bucket's error, against images whose truth is known.
#include "error.h"
#include "partial.h"
#include "random.h"

#include <cmath>
#include <functional>
#include <gtest/gtest.h>
#include <limits>
#include <vector>

namespace pileus {
namespace {

using Truth = std::function<double(int, int)>;

/// A square bucket of a grey image with noise of a variance.
Partial noisy(int side, const Truth& truth, double variance, std::uint64_t seed) {
    Partial partial;
    partial.width = partial.height = side;
    partial.samples = {0, 1};
    partial.image = LayeredImage({0, 0, side, side}, {"beauty"}, channel_names(0));
    Random random(seed);
    for (int y = 0; y < side; ++y) {
        for (int x = 0; x < side; ++x) {
            // Uniform, of variance 1.
            const double noise = (random.uniform() - 0.5) * std::sqrt(12.0);
            for (std::size_t c = Partial::r; c <= Partial::b; ++c) {
                partial.image.plane(0, c)[y * side + x] =
                    static_cast<float>(truth(x, y) + std::sqrt(variance) * noise);
            }
        }
    }
    return partial;
}

/// The squared relative error that the best square makes of both halves together, by trying.
double tried(int side, const Truth& truth, double variance) {
    double least = std::numeric_limits<double>::infinity();
    for (int r = 1; r <= 4; ++r) {
        double squares = 0.0;
        for (int y = 0; y < side; ++y) {
            for (int x = 0; x < side; ++x) {
                double sum = 0.0;
                int count = 0;
                for (int j = std::max(0, y - r); j <= std::min(side - 1, y + r); ++j) {
                    for (int i = std::max(0, x - r); i <= std::min(side - 1, x + r); ++i, ++count)
                        sum += truth(i, j);
                }
                const double level = truth(x, y), bias = sum / count - level;
                squares += (bias * bias + variance / 2.0 / count) / (level * level + 0.01);
            }
        }
        least = std::min(least, squares / (side * side));
    }
    return least;
}

struct Case {
    const char* name;
    Truth truth;
    double variance;
    double low, high;  // of the estimate over the error
};

class SmoothedErrorTest : public testing::TestWithParam<Case> {};

TEST_P(SmoothedErrorTest, IsThatOfTheBestSquare) {
    constexpr int side = 256;
    const Case& each = GetParam();
    const double estimate = smoothed_error(noisy(side, each.truth, each.variance, 1),
                                           noisy(side, each.truth, each.variance, 2), 1.0);
    const double ratio = estimate * estimate / tried(side, each.truth, each.variance);
    EXPECT_GT(ratio, each.low);
    EXPECT_LT(ratio, each.high);
}

double wave(int x, int y, double length) {
    return 1.0 + 0.3 * std::sin(2.0 * M_PI * x / length) * std::cos(2.0 * M_PI * y / length);
}

// The estimate is a standard error high, and where smoothing leaves next to nothing also by how
// surely detail of a pixel's size can be ruled out. At edges an image is no more curved than it
// looks, and the estimate may be low by half, but no more.
INSTANTIATE_TEST_SUITE_P(
    Images, SmoothedErrorTest,
    testing::Values(
        Case{"Flat", [](int, int) { return 1.0; }, 0.1, 0.9, 1.6},
        Case{"Ramp", [](int x, int) { return 0.5 + x / 100.0; }, 0.1, 0.85, 1.6},
        Case{"Billows", [](int x, int y) { return wave(x, y, 40.0); }, 0.1, 0.85, 1.4},
        Case{"SmallBillows", [](int x, int y) { return wave(x, y, 16.0); }, 0.1, 0.85, 1.4},
        Case{"LittleNoise", [](int x, int y) { return wave(x, y, 16.0); }, 0.001, 0.85, 1.4},
        Case{"Edges", [](int x, int) { return x / 16 % 2 ? 1.0 : 0.2; }, 0.05, 0.5, 1.25},
        Case{"Checkers", [](int x, int y) { return (x + y) % 2 ? 1.2 : 0.8; }, 0.02, 0.85, 1.4}),
    [](const auto& info) { return info.param.name; });

TEST(SmoothedError, HasItsMarginOnTop) {
    const Truth flat = [](int, int) { return 1.0; };
    const Partial half = noisy(64, flat, 0.1, 1), other = noisy(64, flat, 0.1, 2);
    const double least = smoothed_error(half, other, 0.0);
    EXPECT_GT(least, 0.0);
    EXPECT_GT(smoothed_error(half, other, 0.5), least);
    EXPECT_GT(smoothed_error(half, other, 1.0), smoothed_error(half, other, 0.5));
}

TEST(SmoothedError, OfFewBlocksIsNeverNoneByChance) {
    const Truth flat = [](int, int) { return 1.0; };
    constexpr double variance = 0.1;
    const double least = variance / 2.0 / 81.0 / 1.01;  // of the mean of both halves
    for (std::uint64_t seed = 0; seed < 200; ++seed) {
        const Partial half = noisy(24, flat, variance, 2 * seed),
                      other = noisy(24, flat, variance, 2 * seed + 1);
        // 576 pixels tell their variance to a twentieth.
        EXPECT_GT(smoothed_error(half, other, 0.0), std::sqrt(0.7 * least)) << seed;
    }
}

TEST(SmoothedError, IsUnknownOfFewPixelsAndRefusedForUnlikeBuckets) {
    const Truth flat = [](int, int) { return 1.0; };
    const Partial small = noisy(23, flat, 0.1, 1), half = noisy(24, flat, 0.1, 1);
    EXPECT_TRUE(std::isinf(smoothed_error(small, small, 1.0)));
    EXPECT_TRUE(std::isfinite(smoothed_error(half, noisy(24, flat, 0.1, 2), 1.0)));
    EXPECT_THROW(smoothed_error(small, half, 1.0), InputError);
}

}  // namespace
}  // namespace pileus
