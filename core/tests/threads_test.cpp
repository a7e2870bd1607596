// What renders of one scene share, several threads at it: `make sanitize` runs this under the
// thread sanitizer. A thread of TBB's pool is one that the sanitizer cannot follow, as the library
// is not built with it; so here each render has one thread, and the threads are the standard
// library's.
#include "support.h"

#include <tbb/global_control.h>

#include <gtest/gtest.h>
#include <thread>

namespace pileus {
namespace {

constexpr int width = 24, height = 16, threads = 4;

class ThreadsTest : public testing::TestWithParam<std::string> {};

TEST_P(ThreadsTest, BucketsOfOneSceneRenderedAtOnceAreThoseOfOneRender) {
    const tbb::global_control one(tbb::global_control::max_allowed_parallelism, 1);
    const auto volume = test::volume_of(test::noise_grid(20, 1, 0.05));
    const std::shared_ptr<const Light> sun =
        make_distant_light(V3f(0.6f, -0.55f, 0.58f).normalized(), Color(3.0f, 2.5f, 2.0f), 3.0f);
    const Camera camera(V3d(0.4, 0.8, -2.0), V3d(0.5, 0.5, 0.5), V3d(0.0, 1.0, 0.0), 40.0);
    const Scene scene =
        test::make_scene(volume, camera, {sun, test::constant_dome(0.4f)},
                         {4.0f, Color(0.9f, 0.8f, 1.0f), 0.5f, width, height, true});
    const Transport transport = test::transport_of(
        GetParam(), GetParam() == "single" ? std::optional<int>() : std::optional<int>(4));
    Control control;
    const auto part = [&](int n) {
        const Bucket rows{0, n * height / threads, width, (n + 1) * height / threads};
        return render(scene, transport, {rows, {0, 4}, 11, 1, 0}, 1, control);
    };
    std::vector<Partial> parts(threads);
    {
        std::vector<std::jthread> running;
        for (int n = 0; n < threads; ++n) {
            running.emplace_back([&, n] { parts[static_cast<std::size_t>(n)] = part(n); });
        }
    }
    for (int n = 0; n < threads; ++n) {
        const Partial alone = part(n);
        const LayeredImage& image = parts[static_cast<std::size_t>(n)].image;
        for (std::size_t channel = 0; channel < image.channels().size(); ++channel) {
            const float* const expected = alone.image.plane(0, channel);
            EXPECT_TRUE(
                std::equal(expected, expected + image.window().pixels(), image.plane(0, channel)))
                << image.channels()[channel];
        }
    }
    EXPECT_EQ(control.samples_done.load(), 2 * 4 * width * height);
}

INSTANTIATE_TEST_SUITE_P(Methods, ThreadsTest,
                         testing::Values("single", "contrast", "multiple", "density", "reference",
                                         "similarity"),
                         [](const auto& info) { return info.param; });

}  // namespace
}  // namespace pileus
