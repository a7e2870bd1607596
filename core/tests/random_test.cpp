// Random numbers: the stratification that scrambled Sobol points owe, and the independence of
// streams and sequences with different keys.
#include "random.h"

#include "path.h"
#include "support.h"

#include <algorithm>
#include <cmath>
#include <gtest/gtest.h>
#include <vector>

namespace pileus {
namespace {

TEST(Sobol, FirstTwoDimensionsFillEveryElementaryInterval) {
    // 2^k points that start anywhere at a multiple of 2^k are a (0, k, 2)-net: each box of area
    // 2^-k with sides 2^-i and 2^-(k-i) holds exactly one of them.
    for (const std::uint64_t key : {0u, 1u, 2u, 77u, 123456u}) {
        for (unsigned k = 1; k <= 12; ++k) {
            for (const unsigned block : {0u, 1u, 5u}) {
                const unsigned count = 1u << k;
                std::vector<std::array<float, sobol::dimensions>> points;
                for (unsigned i = 0; i < count; ++i) {
                    points.push_back(sobol::point(block * count + i, mix64(key)));
                }
                for (unsigned i = 0; i <= k; ++i) {
                    std::vector<int> boxes(count);
                    for (const auto& p : points) {
                        const auto x = static_cast<unsigned>(std::ldexp(p[0], int(i)));
                        const auto y = static_cast<unsigned>(std::ldexp(p[1], int(k - i)));
                        ++boxes[(x << (k - i)) | y];
                    }
                    ASSERT_TRUE(
                        std::all_of(boxes.begin(), boxes.end(), [](int n) { return n == 1; }))
                        << "key " << key << ", " << count << " points, block " << block;
                }
            }
        }
    }
}

TEST(Sobol, EachDimensionIsStratified) {
    constexpr unsigned count = 1024;
    for (std::uint64_t key = 0; key < 20; ++key) {
        for (unsigned d = 0; d < sobol::dimensions; ++d) {
            std::vector<int> strata(count);
            for (unsigned i = 0; i < count; ++i) {
                ++strata[static_cast<unsigned>(sobol::point(i, key)[d] * count)];
            }
            EXPECT_EQ(*std::max_element(strata.begin(), strata.end()), 1) << d;
        }
    }
}

TEST(Sobol, WalksOfAPixelAreStratifiedTogether) {
    constexpr int samples = 128, walks = 2, count = samples * walks;
    std::vector<int> first(count), light(count);
    for (std::uint32_t sample = 0; sample < samples; ++sample) {
        for (int k = 0; k < walks; ++k) {
            const PathRandom numbers = PathRandom(hash_key(5, 7), sample).walk(k, walks);
            Random unused(0);
            ++first[static_cast<std::size_t>(numbers.onward(0, unused)[0] * count)];
            ++light[static_cast<std::size_t>(numbers.light()[3] * count)];
        }
    }
    EXPECT_EQ(*std::max_element(first.begin(), first.end()), 1);
    EXPECT_EQ(*std::max_element(light.begin(), light.end()), 1);
}

/// A chi-square test of pairs against the uniform square.
void expect_uniform_square(const std::vector<std::pair<float, float>>& pairs, int tests) {
    constexpr unsigned side = 16;
    std::vector<int> bins(side * side);
    for (const auto& [x, y] : pairs) {
        ASSERT_GE(std::min(x, y), 0.0f);
        ASSERT_LT(std::max(x, y), 1.0f);
        ++bins[static_cast<unsigned>(x * side) * side + static_cast<unsigned>(y * side)];
    }
    const double expected = double(pairs.size()) / bins.size();
    double chi_square = 0.0;
    for (const int n : bins) chi_square += (n - expected) * (n - expected) / expected;
    EXPECT_LT(chi_square, test::chi_square_limit(0.9999, side * side - 1, tests));
}

TEST(RandomStreams, OfNeighbouringKeysAreIndependent) {
    constexpr int pairs = 200000;
    // Whatever names a stream: the pixel, the sample, the purpose, the order.
    using Pair = std::pair<Random, Random>;
    const std::uint64_t pixel = hash_key(hash_key(1, 2), 3);
    const PathRandom path(pixel, 0), next_sample(pixel, 1),
        next_pixel(hash_key(hash_key(1, 2), 4), 0);
    const std::vector<Pair> neighbours{
        Pair(path.stream(walk_stream), next_sample.stream(walk_stream)),
        Pair(path.stream(walk_stream), next_pixel.stream(walk_stream)),
        Pair(path.stream(walk_stream), path.stream(light_stream)),
        Pair(path.stream(light_stream, 0), path.stream(bridge_stream, 0)),
        Pair(path.stream(light_stream, 1), path.stream(walk_stream, 1)),
        Pair(path.stream(light_stream, 0), path.stream(light_stream, 1)),
    };
    for (auto [a, b] : neighbours) {
        std::vector<std::pair<float, float>> values;
        for (int i = 0; i < pairs; ++i) {
            const float x = a.uniform();
            values.emplace_back(x, b.uniform());
        }
        expect_uniform_square(values, 3 * int(neighbours.size()));
        // The second stream may be the first one shifted.
        std::vector<std::pair<float, float>> shifted;
        for (int i = 0; i + 1 < pairs; ++i) {
            shifted.emplace_back(values[std::size_t(i)].first, values[std::size_t(i) + 1].second);
        }
        expect_uniform_square(shifted, 3 * int(neighbours.size()));
    }
}

TEST(RandomStreams, FirstNumbersOfManyKeysAreIndependent) {
    // What neighbouring pixels see: the n-th number over consecutive keys.
    std::vector<std::pair<float, float>> across, within;
    float previous = 0.5f;
    for (std::uint64_t pixel = 0; pixel < 200000; ++pixel) {
        Random random = PathRandom(hash_key(42, pixel), 0).stream(walk_stream);
        const float first = random.uniform();
        if (pixel % 2) across.emplace_back(previous, first);
        previous = first;
        within.emplace_back(first, random.uniform());
    }
    expect_uniform_square(across, 2);
    expect_uniform_square(within, 2);
}

TEST(RandomStreams, SobolPointsOfDifferentPixelsAreIndependent) {
    for (unsigned d = 0; d < sobol::dimensions; ++d) {
        std::vector<std::pair<float, float>> values;
        for (std::uint64_t pixel = 0; pixel < 100000; ++pixel) {
            values.emplace_back(PathRandom(hash_key(9, 2 * pixel), 3).first[d],
                                PathRandom(hash_key(9, 2 * pixel + 1), 3).first[d]);
        }
        expect_uniform_square(values, sobol::dimensions);
    }
}

}  // namespace
}  // namespace pileus
