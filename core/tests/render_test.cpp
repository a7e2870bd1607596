// What must be equal whatever the order of the work: methods that coincide, looks together and
// alone, recombined orders, buckets, and threads.
#include "camera_rays.h"
#include "error.h"
#include "support.h"

#include <array>
#include <gtest/gtest.h>
#include <numeric>
#include <vector>

namespace pileus {
namespace {

constexpr int width = 20, height = 14;

/// A rough field beside emptiness, partly out of view, under a sun with a disc and a sky.
Scene make_rough_scene(bool background = true) {
    static const auto volume = test::volume_of(test::noise_grid(24, 1, 0.05));
    static const std::shared_ptr<const Light> sun =
        make_distant_light(V3f(0.6f, -0.55f, 0.58f).normalized(), Color(3.0f, 2.5f, 2.0f), 3.0f);
    const Camera camera(V3d(0.4, 0.8, -2.0), V3d(0.9, 0.6, 0.6), V3d(0.0, 1.0, 0.0), 40.0);
    return test::make_scene(volume, camera, {sun, test::constant_dome(0.4f)},
                            {4.0f, Color(0.9f, 0.8f, 1.0f), 0.5f, width, height, background});
}

Partial render_bucket(const Scene& scene, const Transport& transport, const Bucket& bucket,
                      const SampleRange& samples, bool orders = false, int threads = 0) {
    Control control;
    return render(scene, transport, {bucket, samples, 21, 3, orders ? *transport.max_bounces : 0},
                  threads, control);
}

constexpr Bucket whole{0, 0, width, height};

std::vector<float> look_of(const Partial& partial, std::size_t look) {
    const std::size_t size = partial.image.channels().size() * partial.image.window().pixels();
    const float* const first = partial.image.plane(look, 0);
    return {first, first + size};
}

class MethodTest : public testing::TestWithParam<std::string> {
  protected:
    /// With a number of bounces that all methods can keep apart.
    Transport transport(std::vector<Look> looks = {{"physical"}}) const {
        return test::transport_of(
            GetParam(), GetParam() == "single" ? std::optional<int>() : std::optional<int>(5),
            std::move(looks));
    }
};

TEST_P(MethodTest, LooksFromOneWalkAreThoseRenderedAlone) {
    const std::vector<Look> looks{
        {"physical"}, {"hero", 0.65f, 0.65f, 0.5f}, {"flat", 0.0f, 1.0f, 0.0f}, {"again"}};
    const Scene scene = make_rough_scene();
    for (const bool orders : {false, true}) {
        const Partial together = render_bucket(scene, transport(looks), whole, {0, 6}, orders);
        for (std::size_t k = 0; k < looks.size(); ++k) {
            const Partial alone =
                render_bucket(scene, transport({looks[k]}), whole, {0, 6}, orders);
            EXPECT_EQ(look_of(together, k), look_of(alone, 0)) << looks[k].name;
        }
        EXPECT_EQ(look_of(together, 0), look_of(together, 3));
        // The first order is the same in all looks; the sum is not.
        EXPECT_EQ(look_of(together, 0) == look_of(together, 1), GetParam() == "single");
    }
}

TEST_P(MethodTest, OrdersAddUpAndCanBeRegraded) {
    constexpr float b = 0.9f, regraded = 0.55f;
    const Scene scene = make_rough_scene(false);
    const Partial old =
        render_bucket(scene, transport({{"old", 0.6f, b, 0.7f}}), whole, {0, 8}, true);
    const Partial fresh =
        render_bucket(scene, transport({{"new", 0.6f, regraded, 0.7f}}), whole, {0, 8});
    const std::size_t orders = (old.image.channels().size() - Partial::first_order) / 3;
    ASSERT_EQ(orders, GetParam() == "single" ? 1u : 5u);
    double light = 0.0;
    for (std::size_t c = 0; c < 3; ++c) {
        for (std::size_t i = 0; i < whole.pixels(); ++i) {
            double sum = 0.0, recombined = 0.0, factor = 1.0;
            for (std::size_t order = 0; order < orders; ++order, factor *= double{regraded} / b) {
                const double layer = old.image.plane(0, Partial::first_order + 3 * order + c)[i];
                sum += layer;
                recombined += factor * layer;
            }
            light += sum;
            const float before = old.image.plane(0, c)[i], after = fresh.image.plane(0, c)[i];
            ASSERT_NEAR(sum, before, 1e-6 * before + 1e-9);
            ASSERT_NEAR(recombined, after, 1e-5 * after + 1e-9);
        }
    }
    EXPECT_GT(light, 1.0);
}

TEST_P(MethodTest, BucketsInAnyOrderAreTheWholeFrameBitForBit) {
    const Scene scene = make_rough_scene();
    const Transport both = transport({{"physical"}, {"hero", 0.65f, 0.65f, 0.5f}});
    const Partial frame = render_bucket(scene, both, whole, {2, 7});
    const std::vector<std::vector<Bucket>> splits{
        {{16, 0, 20, 14}, {0, 0, 16, 14}},
        {{0, 13, 20, 14}, {0, 0, 7, 5}, {7, 0, 20, 5}, {0, 5, 20, 13}},
        {{19, 13, 20, 14}, {0, 0, 20, 13}, {0, 13, 19, 14}},
    };
    for (const auto& split : splits) {
        for (const Bucket& bucket : split) {
            const Partial part = render_bucket(scene, both, bucket, {2, 7});
            for (std::size_t look = 0; look < 2; ++look) {
                for (std::size_t c = 0; c < part.image.channels().size(); ++c) {
                    for (int y = bucket.y0; y < bucket.y1; ++y) {
                        for (int x = bucket.x0; x < bucket.x1; ++x) {
                            ASSERT_EQ(
                                part.image.plane(
                                    look, c)[(y - bucket.y0) * bucket.width() + x - bucket.x0],
                                frame.image.plane(look, c)[y * width + x])
                                << x << ", " << y << " of " << part.image.channels()[c];
                        }
                    }
                }
            }
        }
    }
}

TEST_P(MethodTest, ThreadsChangeNoBit) {
    const Scene scene = make_rough_scene();
    const Partial one = render_bucket(scene, transport(), whole, {0, 6}, true, 1);
    for (const int threads : {2, 3}) {
        const Partial many = render_bucket(scene, transport(), whole, {0, 6}, true, threads);
        EXPECT_EQ(one.image.data(), many.image.data());
    }
}

TEST_P(MethodTest, SampleRangesAddUp) {
    const Scene scene = make_rough_scene();
    const Partial all = render_bucket(scene, transport(), whole, {0, 12}, true);
    Partial merged = render_bucket(scene, transport(), whole, {0, 5}, true);
    merged.pool(render_bucket(scene, transport(), whole, {5, 6}, true));
    merged.pool(render_bucket(scene, transport(), whole, {6, 12}, true));
    ASSERT_EQ(merged.samples, all.samples);
    for (std::size_t i = 0; i < all.image.data().size(); ++i) {
        ASSERT_NEAR(merged.image.data()[i], all.image.data()[i],
                    1e-6 * std::abs(all.image.data()[i]) + 1e-9);
    }
}

TEST_P(MethodTest, SeedFrameAndPixelChangeTheNoise) {
    const Scene scene = make_rough_scene();
    Control control;
    const auto keyed = [&](std::uint64_t seed, int frame) {
        return render(scene, transport(), {whole, {0, 4}, seed, frame, 0}, 0, control);
    };
    const auto first = keyed(1, 1).image.data();
    EXPECT_EQ(first, keyed(1, 1).image.data());
    EXPECT_NE(first, keyed(2, 1).image.data());
    EXPECT_NE(first, keyed(1, 2).image.data());
    EXPECT_NE(first, keyed(2, 0).image.data());
}

INSTANTIATE_TEST_SUITE_P(All, MethodTest, testing::ValuesIn(method_names()),
                         [](const auto& info) { return info.param; });

TEST(Methods, ContrastOfOneOctaveIsSingle) {
    const Scene scene = make_rough_scene();
    const std::vector<Look> looks{{"physical"}, {"hero", 0.65f, 0.65f, 0.5f}};
    const Partial contrast =
        render_bucket(scene, test::transport_of("contrast", 1, looks), whole, {0, 8});
    const Partial single =
        render_bucket(scene, test::transport_of("single", {}, looks), whole, {0, 8});
    EXPECT_EQ(contrast.image.data(), single.image.data());
    EXPECT_EQ(look_of(single, 0), look_of(single, 1));  // a, b and c have no power at order 0
}

TEST(Scene, BucketsThatTheVolumeCannotTouchSeeOnlySky) {
    // Never a false "no": where it is said, rendering finds nothing.
    const auto volume = test::volume_of(test::noise_grid(10, 5, 0.1));
    Random random(17);
    int untouched = 0;
    for (int i = 0; i < 60; ++i) {
        const auto coordinate = [&] { return 6.0 * random.uniform() - 3.0; };
        const V3d position(coordinate(), coordinate(), coordinate());
        const V3d look_at(coordinate(), coordinate(), coordinate());
        const Camera camera(position, look_at, V3d(0.1, 1.0, 0.2), 20.0 + 140.0 * random.uniform());
        const Scene scene = test::make_scene(volume, camera, {test::constant_dome()},
                                             {50.0f, Color(0.0f), 0.0f, 64, 64});
        const CameraRays rays(scene);
        for (int y = 0; y < 64; y += 16) {
            for (int x = 0; x < 64; x += 16) {
                const Bucket bucket{x, y, x + 16, y + 16};
                if (scene.touches(bucket)) continue;
                ++untouched;
                for (int sub = 0; sub <= 64; ++sub) {
                    for (int row = 0; row <= 64; row += 4) {
                        ASSERT_FALSE(rays.through(x + sub / 4.0, y + row / 4.0).volume);
                    }
                }
            }
        }
    }
    EXPECT_GT(untouched, 200);
}

TEST(Render, RefusesTasksThatDoNotFit) {
    const Scene scene = make_rough_scene();
    const Transport transport = test::transport_of("single");
    const auto attempt = [&](const Bucket& bucket, const SampleRange& samples) {
        render_bucket(scene, transport, bucket, samples);
    };
    EXPECT_THROW(attempt({0, 0, width + 1, height}, {0, 1}), InputError);
    EXPECT_THROW(attempt({-1, 0, width, height}, {0, 1}), InputError);
    EXPECT_THROW(attempt({4, 4, 4, 8}, {0, 1}), InputError);
    EXPECT_THROW(attempt(whole, {0, 0}), InputError);
    EXPECT_THROW(attempt(whole, {-1, 1}), InputError);
    Control control;
    const std::array unlike{RenderTask{whole, {0, 1}, 1, 1, 0}, RenderTask{whole, {0, 1}, 1, 1, 1}};
    EXPECT_THROW(render(scene, transport, unlike, 0, control), InputError);
    EXPECT_THROW(render(scene, transport, {whole, {0, 1}, 1, 1, -1}, 0, control), InputError);
}

TEST(Render, TasksTogetherAreThoseRenderedAlone) {
    // Some of more samples than are gathered at once, in one pixel or in many.
    const Scene scene = make_rough_scene();
    const Transport transport = test::transport_of("reference");
    const std::vector<RenderTask> tasks{{whole, {0, 2}, 1, 1, 0},
                                        {{5, 4, 7, 5}, {3, 5003}, 1, 1, 0},
                                        {whole, {7, 50}, 2, 1, 0},
                                        {{8, 6, 9, 7}, {0, 1}, 1, 2, 0}};
    std::vector<std::vector<float>> alone;
    Control control;
    for (const RenderTask& task : tasks)
        alone.push_back(look_of(render(scene, transport, task, 1, control), 0));
    for (const int threads : {1, 2, 5}) {
        control.samples_done = 0;
        const std::vector<Partial> together = render(scene, transport, tasks, threads, control);
        std::int64_t samples = 0;
        for (std::size_t i = 0; i < tasks.size(); ++i) {
            EXPECT_EQ(look_of(together[i], 0), alone[i]) << i;
            EXPECT_EQ(together[i].samples, tasks[i].samples);
            samples += std::int64_t{tasks[i].samples.count()} *
                       static_cast<std::int64_t>(tasks[i].bucket.pixels());
        }
        EXPECT_EQ(control.samples_done, samples);
    }
}

TEST(Render, TheLastOrderHoldsAllLaterOnes) {
    const Scene scene = make_rough_scene(false);
    Control control;
    const auto orders_of = [&](int orders) {
        const Partial partial = render(scene, test::transport_of("reference"),
                                       {whole, {0, 8}, 1, 1, orders}, 0, control);
        std::vector<double> sums;
        for (std::size_t c = 0; c < partial.image.channels().size(); ++c) {
            const float* const plane = partial.image.plane(0, c);
            sums.push_back(std::accumulate(plane, plane + whole.pixels(), 0.0));
        }
        return sums;
    };
    const std::vector<double> few = orders_of(2), many = orders_of(12);
    constexpr std::size_t first = Partial::first_order;
    for (std::size_t c = 0; c < 3; ++c) {
        EXPECT_EQ(few[first + c], many[first + c]);
        double later = 0.0;
        for (std::size_t i = 1; i < 12; ++i) later += many[first + 3 * i + c];
        EXPECT_NEAR(few[first + 3 + c], later, 1e-5 * later);
        EXPECT_GT(many[first + 33 + c], 0.0);
        EXPECT_NEAR(few[c], few[first + c] + later, 1e-5 * few[c]);
    }
}

TEST(Render, EndsWhenCancelled) {
    Scene scene = make_rough_scene();
    Control control;
    control.cancelled = true;
    EXPECT_THROW(
        render(scene, test::transport_of("multiple"), {whole, {0, 1000000}, 1, 1, 0}, 0, control),
        Cancelled);
    // Also where no ray meets the volume.
    scene.camera = Camera(V3d(0.4, 0.8, -2.0), V3d(0.4, 0.8, -9.0), V3d(0.0, 1.0, 0.0), 40.0);
    EXPECT_THROW(
        render(scene, test::transport_of("multiple"), {whole, {0, 4}, 1, 1, 0}, 0, control),
        Cancelled);
}

}  // namespace
}  // namespace pileus
