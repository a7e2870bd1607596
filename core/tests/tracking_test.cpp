// Delta tracking, ratio tracking and the density march against the exact optical depth of a rough
// trilinear field.
#include "march.h"
#include "support.h"
#include "tracker.h"

#include <array>
#include <cmath>
#include <gtest/gtest.h>
#include <vector>

namespace pileus {
namespace {

/// A field of independent voxels beside a tile, and rays that meet both, or one, or start within,
/// on a corner, and run along cells' faces.
class TrackingTest : public testing::Test {
  protected:
    TrackingTest() {
        const auto grid = test::noise_grid(20, 6, 0.1);
        grid->tree().addTile(1, openvdb::Coord(24, 8, 8), 0.9f, true);
        volume_ = test::volume_of(grid);
        medium_.emplace(*volume_, 2.5f, Color(1.0f), 0.0f);
        const V3d inside = world(V3d(9.3, 11.1, 4.7)), outside = world(V3d(-20.0, 13.0, 40.0));
        rays_ = {
            ray(outside, world(V3d(10.0, 9.0, 10.0)) - outside),
            ray(inside, V3d(1.0, 0.1, 0.3)),
            ray(inside, V3d(-0.2, -1.0, -0.4)),
            ray(world(V3d(8.0, 8.0, 8.0)), V3d(1.0, 0.0, 0.0)),
            ray(world(V3d(16.0, 16.0, 16.0)), V3d(-1.0, -1.0, -1.0)),
            ray(world(V3d(0.0, 12.0, -9.0)), V3d(0.0, 0.0, 1.0)),
        };
    }

    /// The world position of index coordinates.
    static V3d world(const V3d& index) { return index * 0.1; }

    LocalRay ray(const V3d& from, const V3d& along) const {
        return medium_->ray(V3f(from * volume_->world_to_local()), V3f(along.normalized()));
    }

    double depth(const LocalRay& r, double end, double begin = 0.0) const {
        return medium_->majorant(1.0f) *
               test::optical_depth(volume_->tree(), V3d(r.origin), V3d(r.direction), begin, end);
    }

    static constexpr double everything = 20.0;  // world units: beyond the volume for all the rays
    int tests() const { return static_cast<int>(rays_.size()); }

    std::shared_ptr<const Volume> volume_;
    std::optional<Medium> medium_;
    std::vector<LocalRay> rays_;
};

class TrackerTest : public TrackingTest, public testing::WithParamInterface<Boxes> {
  protected:
    /// What so many tracks like this one find, each by random numbers of its own.
    std::vector<Track> follow(Estimator estimator, const Track& like, int count,
                              std::uint64_t key) const {
        std::vector<Track> tracks(static_cast<std::size_t>(count), like);
        Tracker tracker(volume_->tree(), GetParam());
        for (std::size_t i = 0; i < tracks.size(); ++i) {
            Track& track = tracks[i];
            track.random = Random(hash_key(key, i));
            track.first = track.random.uniform();
            tracker.add(estimator, track);
        }
        tracker.run();
        return tracks;
    }

    static Track along(const Medium& medium, const LocalRay& ray, float rate = 1.0f,
                       float power = 1.0f) {
        return {.medium = &medium,
                .ray = ray,
                .random = Random(0),
                .first = 0.0f,
                .power = power,
                .rate = rate};
    }
};

INSTANTIATE_TEST_SUITE_P(In, TrackerTest, testing::Values(Boxes::bricks, Boxes::eights),
                         [](const testing::TestParamInfo<Boxes>& info) {
                             return info.param == Boxes::bricks ? "Bricks" : "Eights";
                         });

TEST_P(TrackerTest, DeltaTrackingFollowsTransmittanceTimesExtinction) {
    constexpr int samples = 200000, bins = 40;
    for (std::size_t r = 0; r < rays_.size(); ++r) {
        const LocalRay& way = rays_[r];
        const double opacity = -std::expm1(-depth(way, everything));
        ASSERT_GT(opacity, 0.05);
        // Edges of equal probability, by bisection.
        std::vector<double> edges;
        for (int i = 1; i < bins; ++i) {
            double low = 0.0, high = everything;
            for (int step = 0; step < 60; ++step) {
                const double middle = 0.5 * (low + high);
                (-std::expm1(-depth(way, middle)) < opacity * i / bins ? low : high) = middle;
            }
            edges.push_back(low);
        }
        std::vector<int> counts(bins + 1);  // the last are those that leave
        for (const Track& found :
             follow(Estimator::collision, along(*medium_, way), samples, 100 + r)) {
            const auto above = std::upper_bound(edges.begin(), edges.end(), double(found.distance));
            ++counts[found.distance == Track::none ? std::size_t(bins)
                                                   : std::size_t(above - edges.begin())];
        }
        double chi_square = 0.0;
        for (int i = 0; i <= bins; ++i) {
            const double expected = samples * (i < bins ? opacity / bins : 1.0 - opacity);
            if (expected < 5.0) continue;
            const double gap = counts[std::size_t(i)] - expected;
            chi_square += gap * gap / expected;
        }
        EXPECT_LT(chi_square, test::chi_square_limit(0.9999, bins, tests())) << "ray " << r;
    }
}

TEST_P(TrackerTest, ForcedCollisionsFollowTransmittanceTimesExtinctionByWeight) {
    constexpr int samples = 200000;
    constexpr std::array<double, 4> ends{0.6, 1.2, 2.4, everything};
    const Medium thin(*volume_, 0.01f, Color(1.0f), 0.0f);
    for (const Medium* const medium : std::array<const Medium*, 2>{&*medium_, &thin}) {
        const double share = medium->majorant(1.0f) / medium_->majorant(1.0f);
        for (std::size_t r = 0; r < rays_.size(); ++r) {
            std::array<std::vector<double>, ends.size()> before;
            for (const float rate : {1.0f, 4.0f}) {
                for (const Track& found :
                     follow(Estimator::forced_collision, along(*medium, rays_[r], rate),
                            samples / 2, 300 + r)) {
                    for (std::size_t e = 0; e < ends.size(); ++e)
                        before[e].push_back(found.distance < ends[e] ? found.weight : 0.0);
                }
            }
            for (std::size_t e = 0; e < ends.size(); ++e) {
                const double wanted = -std::expm1(-share * depth(rays_[r], ends[e]));
                const auto [mean, error] = test::estimate(before[e]);
                EXPECT_NEAR(mean, wanted, test::z_limit(0.9999, 8 * tests()) * error + 1e-6)
                    << "ray " << r << ", before " << ends[e] << ", tau share " << share;
            }
        }
    }
}

TEST_P(TrackerTest, RatioTrackingHasEveryPowerOfTheTransmittanceAsItsMean) {
    constexpr int samples = 200000;
    constexpr std::array<float, 5> powers{1.0f, 0.5f, 0.1f, 1e-6f, 0.0f};
    for (std::size_t r = 0; r < rays_.size(); ++r) {
        const double tau = depth(rays_[r], everything);
        for (const float power : powers) {
            std::vector<double> values;
            for (const float rate : {1.0f, 2.5f}) {
                for (const Track& found :
                     follow(Estimator::transmittance, along(*medium_, rays_[r], rate, power),
                            samples / 2, 200 + r)) {
                    values.push_back(found.weight);
                }
            }
            const auto [mean, error] = test::estimate(values);
            const double limit = test::z_limit(0.9999, tests() * int(powers.size()));
            // A power so small is hardly ever noticed, and then by an error that is as small.
            EXPECT_NEAR(mean, std::exp(-power * tau), limit * error + 10.0 * 1e-6 * (power < 1e-3f))
                << "ray " << r << ", T^" << power << ", tau " << tau;
        }
    }
}

TEST_P(TrackerTest, ThickMediaEndEstimatesWithoutBias) {
    // Optical depths of hundreds: nearly all estimates end early, by roulette.
    const Medium thick(*volume_, 60.0f, Color(1.0f), 0.0f);
    for (const LocalRay& way : rays_) {
        const double tau = 60.0 / 2.5 * depth(way, everything);
        const float power = static_cast<float>(std::min(1.0, 3.0 / tau));
        std::vector<double> values;
        for (const Track& found :
             follow(Estimator::transmittance, along(thick, way, 1.0f, power), 100000, 17)) {
            values.push_back(found.weight);
        }
        const auto [mean, error] = test::estimate(values);
        EXPECT_NEAR(mean, std::exp(-power * tau), test::z_limit(0.9999, tests()) * error);
    }
}

TEST_P(TrackerTest, AMediumWithoutExtinctionIsNoObstacle) {
    const Medium clear(*volume_, 0.0f, Color(1.0f), 0.0f);
    for (const LocalRay& way : rays_) {
        // A flight of no length through it is the one in 2^24 that could find no end.
        Track flight = along(clear, way), light = flight,
              faint = along(*medium_, way, 1.0f, 1e-45f), none = along(*medium_, way, 1.0f, 0.0f);
        faint.first = 0.5f;
        Tracker tracker(volume_->tree(), GetParam());
        tracker.add(Estimator::collision, flight);
        for (Track* const track : {&light, &faint, &none})
            tracker.add(Estimator::transmittance, *track);
        tracker.run();
        EXPECT_EQ(flight.distance, Track::none);
        EXPECT_EQ(light.weight, 1.0f);
        EXPECT_EQ(faint.weight, 1.0f);
        EXPECT_EQ(none.weight, 1.0f);
    }
}

TEST_P(TrackerTest, FindsTheSameWithHoweverManyLanesAndWhateverElseIsTracked) {
    // Five media, so that no two neighbouring lanes have the same work.
    std::vector<Medium> media;
    for (int i = 0; i < 5; ++i)
        media.emplace_back(*volume_, std::pow(4.0f, float(i) - 1.0f), Color(1.0f), 0.0f);
    for (const Estimator estimator :
         {Estimator::collision, Estimator::forced_collision, Estimator::transmittance}) {
        std::vector<Track> tracks;
        for (std::size_t i = 0; i < 3000; ++i) {
            const LocalRay& way = rays_[i % rays_.size()];
            tracks.push_back(along(media[i % media.size()], way, i % 3 == 0 ? 2.0f : 1.0f));
            tracks.back().random = Random(hash_key(7, i));
            tracks.back().first = unit_float(static_cast<std::uint32_t>(mix64(i)));
        }
        std::vector<Track> alone = tracks;
        for (Track& track : alone) {
            Tracker tracker(volume_->tree(), GetParam(), 4);
            tracker.add(estimator, track);
            tracker.run();
        }
        for (const int width : Tracker::widths()) {
            std::vector<Track> together = tracks;
            Tracker tracker(volume_->tree(), GetParam(), width);
            for (Track& track : together) tracker.add(estimator, track);
            tracker.run();
            for (std::size_t i = 0; i < tracks.size(); ++i) {
                ASSERT_EQ(together[i].distance, alone[i].distance)
                    << width << " lanes, track " << i;
                ASSERT_EQ(together[i].weight, alone[i].weight) << width << " lanes, track " << i;
                ASSERT_EQ(together[i].random.state(), alone[i].random.state());
            }
        }
    }
}

TEST_P(TrackerTest, LocalStepsAreThoseOfTheExtinctionWhereTheyStart) {
    // From anywhere in the box, whether its extinction is known or not; two flights in a hundred
    // have no length.
    const V3d low(volume_->tree().low()), size = V3d(volume_->tree().high()) - low;
    std::vector<Track> from;
    for (std::size_t i = 0; i < 3000; ++i) {
        Random random(hash_key(3, i));
        const auto unit = [&] { return double{random.uniform()}; };
        const V3f position(low + V3d(unit(), unit(), unit()) * size);
        const V3f towards(V3d(unit(), unit(), unit()) - V3d(0.5));
        Track track = along(*medium_, medium_->ray(position, towards.normalized()));
        track.first = i % 50 == 0 ? 0.0f : random.uniform();
        track.random = random;
        if (i % 3 == 0) track.local = medium_->extinction(position);
        from.push_back(track);
    }
    for (const int width : Tracker::widths()) {
        std::vector<Track> found = from;
        Tracker tracker(volume_->tree(), GetParam(), width);
        for (Track& track : found) tracker.add(Estimator::local_step, track);
        tracker.run();
        int met = 0, left = 0, flown = 0;
        for (std::size_t i = 0; i < from.size(); ++i) {
            Track expected = from[i];
            const float local = medium_->extinction(expected.ray.origin);
            if (local > 0.0f)
                expected.ray.origin = expected.ray.at(-std::log(1.0f - expected.first) / local);
            const V3f end = expected.ray.origin;
            const V3f low(volume_->tree().low()), high(volume_->tree().high());
            bool inside = true;
            for (int axis = 0; axis < 3; ++axis)
                inside &= end[axis] >= low[axis] && end[axis] < high[axis];
            if (!inside) {
                ++left;
                EXPECT_EQ(found[i].distance, Track::none) << i;
                continue;
            }
            const float there = medium_->extinction(end);
            EXPECT_LT((found[i].ray.origin - end).length(), 1e-5f * (1.0f + end.length())) << i;
            if (there > 0.0f) {
                ++met;
                EXPECT_EQ(found[i].distance, 0.0f) << i;
                EXPECT_NEAR(found[i].local, there, 1e-4f) << i;
                continue;
            }
            ++flown;
            expected.ray.origin = found[i].ray.origin;
            expected.first = expected.random.uniform();
            tracker.add(Estimator::collision, expected);
            tracker.run();
            EXPECT_EQ(found[i].distance, expected.distance) << i;
            EXPECT_LT(found[i].local, 0.0f);
        }
        EXPECT_GT(std::min({met, left, flown}), 100);
    }
}

TEST_F(TrackingTest, RaysTurnAsThePhaseFunctionDoesAlone) {
    // Also along the axes, where the frame's formulas have their corners.
    std::vector<V3f> ways = {V3f(0, 0, 1), V3f(0, 0, -1), V3f(1, 0, 0), V3f(0, -1, 0)};
    Random random(7);
    while (ways.size() < 50) {
        const auto coordinate = [&] { return 2.0f * random.uniform() - 1.0f; };
        const V3f way(coordinate(), coordinate(), coordinate());
        if (way.length() > 0.1f) ways.push_back(way.normalized());
    }
    for (const float g : {-0.999f, -0.3f, 0.0f, 0.85f, 0.9999f}) {
        const HenyeyGreenstein phase(g);
        for (const int width : Tracker::widths()) {
            Tracker tracker(volume_->tree(), Boxes::bricks, width);
            const Track from{.medium = &*medium_,
                             .ray = {V3f(0.5f), V3f(0.0f)},
                             .random = Random(1),
                             .first = 0.5f};
            std::vector<Track> straight(ways.size(), from), turning(ways.size(), from);
            std::vector<Turn> turns;
            for (std::size_t i = 0; i < ways.size(); ++i) {
                const float u1 = i % 7 == 0 ? 0.0f : random.uniform();
                turns.push_back({&phase, ways[i], u1, i % 11 == 0 ? 0.0f : random.uniform()});
            }
            for (std::size_t i = 0; i < ways.size(); ++i) {
                straight[i].ray.direction = ways[i];
                tracker.add(Estimator::collision, straight[i]);
                tracker.add(Estimator::collision, turns[i], turning[i]);
            }
            tracker.run();
            for (std::size_t i = 0; i < ways.size(); ++i) {
                const auto [direction, inverse_density] =
                    phase.sample(ways[i], turns[i].u1, turns[i].u2);
                EXPECT_EQ(turns[i].onward.direction, direction) << g << " " << ways[i];
                EXPECT_EQ(turns[i].onward.inverse_density, inverse_density);
                EXPECT_EQ(turning[i].ray.direction, medium_->ray(V3f(0.0f), direction).direction);
                EXPECT_EQ(straight[i].ray.direction, ways[i]);
            }
        }
    }
}

TEST_F(TrackingTest, TheMarchSumsTheOpticalDepthWithoutBias) {
    // Over its jitter, the march's depth has the exact depth as its mean; at many stratified
    // jitters the sum is a fine quadrature.
    constexpr int jitters = 2048;
    for (const LocalRay& along : rays_) {
        const double tau = depth(along, everything);
        ASSERT_LT(tau, 8.0) << "too thick for an opacity in float";
        DensityMarch march;
        double sum = 0.0;
        for (int i = 0; i < jitters; ++i) {
            march.march(*medium_, along, (float(i) + 0.5f) / jitters);
            sum += -std::log1p(-double(march.opacity()));
        }
        EXPECT_NEAR(sum / jitters, tau, 1e-4 * tau + 2e-7 * std::exp(tau));
    }
}

TEST_F(TrackingTest, TheMarchInvertsItsOwnOpacity) {
    DensityMarch march;
    for (const LocalRay& along : rays_) {
        march.march(*medium_, along, 0.5f);
        float previous = 0.0f;
        for (int i = 0; i < 1000; ++i) {
            const float u = float(i) / 1000.0f;
            const float t = march.invert(u);
            ASSERT_GE(t, previous * (1.0f - 1e-6f));
            previous = t;
            // A step's optical depth under the majorant is at most 0.3: the depth up to t is the
            // march's own up to that, and what its reads of a rough field err by.
            const double expected = -std::log1p(-double(u * march.opacity()));
            ASSERT_NEAR(depth(along, t), expected, 0.35);
        }
        EXPECT_LT(march.invert(std::nextafter(1.0f, 0.0f)), everything);
    }
}

TEST_F(TrackingTest, EventsOfTheMarchFollowTheExactDensityOnAverage) {
    constexpr int samples = 100000;
    // The mean distance of the first event, given that there is one, within a tenth of a voxel of
    // the exact one.
    for (std::size_t r = 0; r < rays_.size(); ++r) {
        const LocalRay& along = rays_[r];
        const double opacity = -std::expm1(-depth(along, everything));
        // E[t; event] = integral of t dP = integral of (P(all) - P(t)) dt.
        double expected = 0.0, tau = 0.0;
        constexpr int steps = 4000;
        for (int i = 0; i < steps; ++i) {
            const double width = everything / steps;
            const double half = depth(along, (i + 0.5) * width, i * width);
            expected += width * (opacity + std::expm1(-(tau + half)));
            tau += half + depth(along, (i + 1.0) * width, (i + 0.5) * width);
        }
        expected /= opacity;
        std::vector<double> values;
        Random random(300 + r);
        DensityMarch march;
        for (int i = 0; i < samples; ++i) {
            march.march(*medium_, along, random.uniform());
            values.push_back(march.invert(random.uniform()));
        }
        const auto [mean, error] = test::estimate(values);
        EXPECT_NEAR(mean, expected, 0.01 + test::z_limit(0.9999, tests()) * error) << "ray " << r;
    }
}

}  // namespace
}  // namespace pileus
