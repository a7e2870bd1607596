// The Henyey-Greenstein sampler against its own density: a chi-square test, and the mean cosine.
#include "phase.h"

#include "random.h"

#include <cmath>
#include <gtest/gtest.h>
#include <vector>

namespace pileus {
namespace {

class HenyeyGreensteinTest : public testing::TestWithParam<float> {};

/// The share of the density with cosine below mu (integrated in closed form, in double).
double cumulative(double g, double mu) {
    if (std::abs(g) < 1e-6) return 0.5 * (1.0 + mu);
    return (1.0 - g * g) / (2.0 * g) *
           (1.0 / std::sqrt(1.0 + g * g - 2.0 * g * mu) - 1.0 / (1.0 + g));
}

TEST_P(HenyeyGreensteinTest, SamplesFollowTheDensity) {
    const double g = GetParam();
    const HenyeyGreenstein phase(GetParam());
    constexpr int bins = 64, samples = 1 << 18;
    // Bins of equal probability: their edges invert `cumulative` by bisection.
    std::vector<double> edges;
    for (int i = 1; i < bins; ++i) {
        double low = -1.0, high = 1.0;
        for (int step = 0; step < 100; ++step) {
            const double middle = 0.5 * (low + high);
            (cumulative(g, middle) < double(i) / bins ? low : high) = middle;
        }
        edges.push_back(low);
    }
    std::vector<int> counts(bins);
    std::vector<int> azimuths(bins);
    const V3f in = V3f(0.3f, -0.5f, 0.7f).normalized();
    V3f u, v;
    make_frame(in, u, v);
    Random random(7);
    for (int i = 0; i < samples; ++i) {
        const float u1 = random.uniform(), u2 = random.uniform();
        const auto [out, inverse_density] = phase.sample(in, u1, u2);
        EXPECT_NEAR(out.length(), 1.0f, 1e-6f);
        // What a float's direction can tell of a peak is less than the sampler knows.
        const double blur = 1e-6 / (1.0 - std::abs(g)) / (1.0 - std::abs(g));
        EXPECT_NEAR(phase.density(in, out) * inverse_density, 1.0, 1e-5 + blur);
        // The angle from the nearer pole, so that peaks keep their precision.
        const double from_peak = 0.5 * double((g >= 0 ? in - out : in + out).length2());
        const double mu = g >= 0 ? 1.0 - from_peak : from_peak - 1.0;
        ++counts[std::size_t(std::upper_bound(edges.begin(), edges.end(), mu) - edges.begin())];
        const double azimuth =
            std::atan2(double(out.dot(v)), double(out.dot(u))) / (2.0 * std::numbers::pi) + 0.5;
        ++azimuths[std::min<std::size_t>(bins - 1, std::size_t(azimuth * bins))];
    }
    for (const auto& histogram : {counts, azimuths}) {
        double chi_square = 0.0;
        const double expected = double(samples) / bins;
        for (const int count : histogram)
            chi_square += (count - expected) * (count - expected) / expected;
        EXPECT_LT(chi_square, 117.0);  // 63 degrees of freedom, 99.995 %
    }
}

TEST_P(HenyeyGreensteinTest, DensityIntegratesToOneWithMeanCosineG) {
    const double g = GetParam();
    const HenyeyGreenstein phase(GetParam());
    // The midpoint rule in 1 - |cos| on a logarithmic grid about the peak.
    double total = 0.0, mean = 0.0;
    constexpr int steps = 200000;
    const double lowest = std::log(1e-9), span = std::log(2.0) - lowest;
    for (int i = 0; i < steps; ++i) {
        const double from_peak = std::exp(lowest + span * (i + 0.5) / steps);
        const double weight = from_peak * span / steps * 2.0 * std::numbers::pi;
        const double cosine = g >= 0 ? 1.0 - from_peak : from_peak - 1.0;
        const V3f in(0.0f, 0.0f, 1.0f);
        const float sine = float(std::sqrt(from_peak * (2.0 - from_peak)));
        const double density = phase.density(in, V3f(sine, 0.0f, float(cosine)));
        total += density * weight;
        mean += density * weight * cosine;
    }
    EXPECT_NEAR(total, 1.0, 2e-3);
    EXPECT_NEAR(mean, g, 2e-3);
}

INSTANTIATE_TEST_SUITE_P(Anisotropies, HenyeyGreensteinTest,
                         testing::Values(-0.999f, -0.9f, -0.3f, -1e-4f, 0.0f, 1e-3f, 0.5f, 0.85f,
                                         0.95f, 0.99f, 0.999f));

}  // namespace
}  // namespace pileus
